"""Gymnasium environments as a server of `tandem.v1.Environment`."""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import signal
import struct
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tandem._describe import TaskOptions, describe, environment_errors
from tandem._failures import Raised, Tracebacks
from tandem._grpc import Path, Refused, Server, ServiceError, grpc
from tandem._gym import EnvFn, GymEnvironment, InvalidEpisode, contact_bits, first_outside, make
from tandem._proto import environment_pb2, environment_pb2_grpc
from tandem._task import Arm, Floats, Manipulation, Norm, Reflection, Task

LISTEN_VARIABLE = "TANDEM_ENV_LISTEN"
"""The environment variable with the address on which a worker wants its server to listen."""
_FLOAT = np.dtype("<f4")
_GRACE_S = 5.0
"""Time in which a process of environments must end once its stream has ended."""


def episode_seed(seed: int, episode: int) -> int:
    """Returns the seed with which a server resets an environment for an episode of a run: 32 bits, from 0.

    `env.reset(seed=tandem.episode_seed(777, k))` starts test goal `k` of a run in an environment of one's own.

    It is the little-endian number in the first four bytes of SHA-256 of seed and episode, each as eight little-endian
    bytes.
    """
    digest = hashlib.sha256(struct.pack("<QQ", seed, episode)).digest()
    return int.from_bytes(digest[:4], "little")


class _Environments:
    """Environments of a stream, stepped one after the other. They are created when they are first reset."""

    def __init__(self, create: Callable[[], GymEnvironment]) -> None:
        self._create = create
        self._environments: dict[int, GymEnvironment] = {}

    def reset(self, resets: Sequence[tuple[int, int]]) -> list[tuple[Floats, Floats]]:
        """Resets environments, given as pairs of index and seed."""
        answers = []
        for index, seed in resets:
            with _named(index):
                if index not in self._environments:
                    self._environments[index] = self._create()
                observation, goal, _ = self._environments[index].reset(seed)
                answers.append((observation, goal))
        return answers

    def step(self, actions: Sequence[tuple[int, Floats]]) -> list[tuple[Floats, int]]:
        """Executes actions, given with the indices of their environments.

        Returns:
            For each, the observation and the contacts of the step as the bits of the protocol.
        """
        answers = []
        for index, action in actions:
            with _named(index):
                observation, _, info = self._environments[index].step(action)
                answers.append((observation, contact_bits(info)))
        return answers

    def close(self) -> None:
        for environment in self._environments.values():
            environment.close()


class EnvironmentFailure(Exception):
    """An exception of an environment, with its text. A process sends it to the server by pickling it."""

    def __init__(self, text: str, *, is_final: bool = False, raised: Raised | None = None) -> None:
        super().__init__(text)
        self.is_final = is_final
        """Whether the same episode would fail again."""
        self.raised = raised
        """The exception, unless the environment broke a rule of episodes."""


@contextlib.contextmanager
def _named(index: int) -> Iterator[None]:
    try:
        yield
    except InvalidEpisode as error:
        raise EnvironmentFailure(f"environment {index}: {error}", is_final=True) from error
    except (Exception, SystemExit) as error:
        raised = Raised.of(error)
        raise EnvironmentFailure(f"environment {index}: {raised.text}", raised=raised) from error


def _serve_pipe(pipe: Any, pickled: bytes) -> None:
    """Runs environments in a process of their own, until the pipe is closed."""
    import cloudpickle

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    environments = _Environments(cloudpickle.loads(pickled))
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            method, argument = pipe.recv()
            try:
                pipe.send((True, getattr(environments, method)(argument)))
            except EnvironmentFailure as error:
                pipe.send((False, error))
    environments.close()


def _pickled(create: Callable[[], GymEnvironment]) -> bytes:
    """Returns what creates an environment in another process."""
    import cloudpickle

    try:
        pickled: bytes = cloudpickle.dumps(create)
        return pickled
    except Exception as error:  # Objects raise errors of their own.
        message = f"the environment cannot be created in other processes: {type(error).__name__}: {error}"
        raise ServiceError(f"{message}; workers=1 needs none") from error


class _ProcessPool:
    """Environments of a stream, divided among processes that step them at the same time."""

    def __init__(self, pickled: bytes, n_processes: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipes = []
        self._processes = []
        for _ in range(n_processes):
            pipe, theirs = context.Pipe()
            process = context.Process(target=_serve_pipe, args=(theirs, pickled), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(pipe)
            self._processes.append(process)

    def reset(self, resets: Sequence[tuple[int, int]]) -> list[Any]:
        return self._divide("reset", resets)

    def step(self, actions: Sequence[tuple[int, Floats]]) -> list[Any]:
        return self._divide("step", actions)

    def close(self) -> None:
        for pipe in self._pipes:
            pipe.close()
        for process in self._processes:
            process.join(_GRACE_S)
        self._kill()

    def abandon(self) -> None:
        """Ends the processes if an environment hangs, which also ends the wait for its answer."""
        timer = threading.Timer(_GRACE_S, self._kill)
        timer.daemon = True
        timer.start()

    def _kill(self) -> None:
        for process in self._processes:
            if process.is_alive():
                process.kill()

    def _divide(self, method: str, items: Sequence[tuple[int, Any]]) -> list[Any]:
        """Sends each item to the process of its environment, and returns the answers in the order of the items."""
        shares: dict[int, list[int]] = {}
        for position, (index, _) in enumerate(items):
            shares.setdefault(index % len(self._pipes), []).append(position)
        answers: list[Any] = [None] * len(items)
        failure: EnvironmentFailure | None = None
        try:
            for number, share in shares.items():
                self._pipes[number].send((method, [items[position] for position in share]))
            for number, share in shares.items():
                succeeded, answer = self._pipes[number].recv()
                if not succeeded:
                    failure = failure or answer
                    continue
                for position, one in zip(share, answer):
                    answers[position] = one
        except (EOFError, OSError) as error:
            raise EnvironmentFailure("a process of the environments ended unexpectedly") from error
        if failure is not None:
            raise failure
        return answers


class _Stream:
    """The state of one `Play` stream."""

    def __init__(self, task: Task, environments: _Environments | _ProcessPool, max_environments: int) -> None:
        self._task = task
        self._environments = environments
        self._max = max_environments
        self._n = 0

    def answer(self, request: environment_pb2.PlayRequest) -> environment_pb2.PlayResponse:
        """Executes one request."""
        command = request.WhichOneof("command")
        if command == "reset":
            return self._reset(request.reset)
        if command == "step":
            return self._step(request.step)
        raise _invalid("command: expected reset or step")

    def _reset(self, request: environment_pb2.ResetEnvironments) -> environment_pb2.PlayResponse:
        resets = request.environments
        indices = [reset.environment for reset in resets]
        if self._n == 0:
            self._check_first(indices)
            self._n = len(indices)
        for position, index in enumerate(indices):
            field = f"reset.environments[{position}].environment"
            if index >= self._n:
                raise _invalid(f"{field}: expected 0 to {self._n - 1}, got {index}")
            if index in indices[:position]:
                raise _invalid(f"{field}: {index} is named twice")
        pairs = [(reset.environment, episode_seed(reset.seed, reset.episode)) for reset in resets]
        answers = self._environments.reset(pairs)
        observations = b"".join(observation.astype(_FLOAT).tobytes() for observation, _ in answers)
        goals = b"".join(goal.astype(_FLOAT).tobytes() for _, goal in answers)
        return environment_pb2.PlayResponse(observations=observations, goals=goals)

    def _check_first(self, indices: list[int]) -> None:
        if not 1 <= len(indices) <= self._max:
            raise _invalid(f"reset.environments: expected 1 to {self._max}, got {len(indices)}")
        if indices != list(range(len(indices))):
            raise _invalid("reset.environments: the first request resets environments 0, 1, ... in this order")

    def _step(self, request: environment_pb2.StepEnvironments) -> environment_pb2.PlayResponse:
        if self._n == 0:
            raise _invalid("command: the first request must be reset")
        actions = decode_floats("step.actions", request.actions, self._n, self._task.n_action)
        check_actions("step.actions", actions)
        answers = self._environments.step(list(enumerate(actions)))
        observations = b"".join(observation.astype(_FLOAT).tobytes() for observation, _ in answers)
        contacts = bytes(bits for _, bits in answers) if self._task.reports_contacts else b""
        return environment_pb2.PlayResponse(observations=observations, contacts=contacts)


def _invalid(message: str) -> Refused:
    return Refused(grpc.StatusCode.INVALID_ARGUMENT, message)


def decode_floats(field: str, data: bytes, n_rows: int, n_columns: int) -> Floats:
    """Returns the array in a field, shape `[n_rows, n_columns]`."""
    expected = 4 * n_rows * n_columns
    if len(data) != expected:
        raise _invalid(f"{field}: expected {expected} bytes, got {len(data)}")
    return np.frombuffer(data, _FLOAT).astype(np.float32).reshape(n_rows, n_columns)


def check_actions(field: str, actions: Floats) -> None:
    """Refuses actions with a number outside [-1, 1], or one that is not a number."""
    index = first_outside(actions)
    if index is not None:
        raise _invalid(f"{field}[{index}]: expected a number in [-1, 1], got {actions.ravel()[index]:g}")


class _Servicer(environment_pb2_grpc.EnvironmentServicer):
    """The service `tandem.v1.Environment`."""

    def __init__(
        self,
        task: Task,
        open_environments: Callable[[], _Environments | _ProcessPool],
        *,
        n: int,
        max_streams: int,
    ) -> None:
        self._task = task
        self._open_environments = open_environments
        self._n = n
        self._room = threading.Semaphore(max_streams)
        self._max_streams = max_streams
        self._tracebacks = Tracebacks()

    def Describe(self, request: Any, context: Any) -> environment_pb2.EnvironmentDescription:
        return environment_pb2.EnvironmentDescription(
            task=self._task.to_message(), server=server_name(), max_environments=self._n
        )

    def Play(self, requests: Any, context: Any) -> Iterator[environment_pb2.PlayResponse]:
        if not self._room.acquire(blocking=False):
            message = f"the server plays {self._max_streams} streams already"
            context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, message)
        try:
            yield from self._play(requests, context)
        except Refused as error:
            context.abort(error.code, str(error))
        except EnvironmentFailure as error:
            self._tracebacks.print(error, error.raised)
            code = grpc.StatusCode.DATA_LOSS if error.is_final else grpc.StatusCode.INTERNAL
            context.abort(code, str(error))
        except grpc.RpcError:
            pass  # The client has gone.
        finally:
            self._room.release()

    def _play(self, requests: Any, context: Any) -> Iterator[environment_pb2.PlayResponse]:
        try:
            environments = self._open_environments()
        except OSError as error:
            raise EnvironmentFailure(f"cannot start the processes of the environments: {error}") from error
        if isinstance(environments, _ProcessPool):
            context.add_callback(environments.abandon)
        with contextlib.closing(environments):
            stream = _Stream(self._task, environments, self._n)
            for request in requests:
                yield stream.answer(request)


def server_name() -> str:
    """Returns name and version of this program, for logs."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"tandem-python {version('tandem-rl')}"
    except PackageNotFoundError:
        return "tandem-python"


class EnvironmentServer(Server):
    """A running server of environments: a context manager, with its address in `address` and its task in `task`."""

    def __init__(
        self,
        env_fn: EnvFn,
        *,
        listen: str = "127.0.0.1:0",
        n: int = 64,
        workers: int = 1,
        max_streams: int = 16,
        name: str | None = None,
        arms: Sequence[Arm] | None = None,
        achieved_goal: Sequence[int] | None = None,
        interchangeable_arms: bool | None = None,
        origin_distance: float | None = None,
        recombination_gap: float | None = None,
        base: float | None = None,
        contact_distances: Sequence[float] | None = None,
        manipulation: Manipulation | None = None,
        reflection: Reflection | None = None,
        reports_contacts: bool | None = None,
        tolerance: float | None = None,
        norm: Norm | None = None,
        episode_steps: int | None = None,
        goal_bound: Sequence[float] | None = None,
        bound: float | None = None,
        token_file: Path | None = None,
        tls_cert: Path | None = None,
        tls_key: Path | None = None,
        insecure: bool = False,
    ) -> None:
        if not 1 <= n <= 1024:
            raise ServiceError(f"a stream has 1 to 1024 environments, not {n}")
        if workers < 1 or max_streams < 1:
            raise ServiceError("workers and max_streams must be at least 1")
        given = {
            "name": name,
            "arms": arms,
            "achieved_goal": achieved_goal,
            "interchangeable_arms": interchangeable_arms,
            "origin_distance": origin_distance,
            "recombination_gap": recombination_gap,
            "base": base,
            "contact_distances": contact_distances,
            "manipulation": manipulation,
            "reflection": reflection,
            "reports_contacts": reports_contacts,
            "tolerance": tolerance,
            "norm": norm,
            "episode_steps": episode_steps,
            "goal_bound": goal_bound,
            "bound": bound,
        }
        with environment_errors(), contextlib.closing(make(env_fn)) as env:
            self.task, appends_goal = describe(env, TaskOptions.combined(env, given))
        task = self.task

        def create() -> GymEnvironment:
            return GymEnvironment(make(env_fn), task, appends_goal)

        pickled = _pickled(create) if workers > 1 else b""

        def open_environments() -> _Environments | _ProcessPool:
            return _ProcessPool(pickled, workers) if workers > 1 else _Environments(create)

        servicer = _Servicer(task, open_environments, n=n, max_streams=max_streams)
        super().__init__(
            lambda server: environment_pb2_grpc.add_EnvironmentServicer_to_server(servicer, server),
            listen=listen,
            token_file=token_file,
            tls_cert=tls_cert,
            tls_key=tls_key,
            insecure=insecure,
            max_streams=max_streams,
        )


def serve(env_fn: EnvFn, *, listen: str | None = None, **options: Any) -> None:
    """Serves environments until the process is asked to end, by SIGINT or SIGTERM.

    Prints `listening on http://HOST:PORT` once it serves. `listen` defaults to the environment variable
    `TANDEM_ENV_LISTEN`, or a free port of 127.0.0.1. If the variable is set, the server also ends when standard input
    is closed.

    An environment may describe itself: the arguments from `name` to `bound` default to the items of the dictionary
    `tandem_task`, an attribute of the environment. Those of this package's simulator describe their built-in task.

    Arguments:
      env_fn: a function that creates a Gymnasium environment, or an id for `gymnasium.make`. The observation is a Dict
        of observation, achieved_goal and desired_goal; the action space is a bounded Box.
      n: the largest number of environments of a stream.
      workers: the number of processes that step the environments of a stream, to which cloudpickle sends `env_fn`; with
        1, the server's own.
      max_streams: the largest number of simultaneous streams.
      name: the name of the task; by default the environment's id in lower case.
      arms: the indices of each arm's part of the vectors (`tandem.Arm`); by default one arm with all of them.
      achieved_goal: the indices of the achieved goal in the observation; by default they are found by playing.
      interchangeable_arms: whether exchanging the parts of two arms gives another valid transition.
      origin_distance, recombination_gap, base: where parts of two arms from different steps may be recombined, as in
        `tandem.v1.TaskDescription`; for arms with `position`.
      contact_distances: distances along that axis, across it and up below which two hands are in contact, for arms with
        `hand`; transitions with contacts are then also made from steps of different episodes.
      manipulation: what the arms share, and what success needs beyond the distance to the goal (`tandem.Manipulation`).
      reflection: a mirror symmetry of the world, with which each transition is learned from in two ways
        (`tandem.Reflection`).
      reports_contacts: whether infos have `arm_contact`, and optionally `table_contact`, which learning then charges. One
        arm without `arm_contact` touches no other; infos without `table_contact` count as no contact with the table.
      tolerance, norm: when a goal counts as achieved; by default `distance_threshold` of the environment, and the norm
        with which its rewards agree.
      episode_steps: control steps per episode; by default `max_episode_steps` of its spec.
      goal_bound: the largest magnitude of each number of a desired goal; by default that of its space.
      bound: the largest magnitude of numbers for which the spaces have no bound, or 0; by default 1000.
      token_file, tls_cert, tls_key, insecure: as the options of the same names of Tandem's services.

    Raises:
      ServiceError: if the environment cannot be used, or the address cannot be served.
    """
    variable = os.environ.get(LISTEN_VARIABLE)
    address = listen or variable or "127.0.0.1:0"
    run(lambda: EnvironmentServer(env_fn, listen=address, **options), ends_with_stdin=variable is not None)


def run(start: Callable[[], Server], *, ends_with_stdin: bool = False) -> None:
    """Starts a server, prints its address, and stops it when the process is asked to end, also while it starts."""
    asked = threading.Event()
    is_starting = True

    def ask(_number: int, _frame: Any) -> None:
        asked.set()
        if is_starting:
            raise KeyboardInterrupt

    is_main = threading.current_thread() is threading.main_thread()
    handlers = {}
    if is_main:
        for number in (signal.SIGINT, signal.SIGTERM):
            handlers[number] = signal.signal(number, ask)
    try:
        if ends_with_stdin:
            threading.Thread(target=_wait_for_end_of_stdin, args=(asked,), daemon=True).start()
        with start() as server:
            is_starting = False
            print(f"listening on {server.address}", flush=True)
            while not asked.wait(0.5):
                pass  # A short wait lets Python handle signals on all systems.
    except KeyboardInterrupt:
        if not asked.is_set():
            raise
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _wait_for_end_of_stdin(asked: threading.Event) -> None:
    try:
        descriptor = sys.stdin.fileno()
        while os.read(descriptor, 4096):
            pass
    except (AttributeError, OSError, ValueError):
        pass
    asked.set()
