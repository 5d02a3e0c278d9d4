"""Clients of Tandem's services: `Teacher`, `Learner` and `Bridge`.

Addresses are `HOST:PORT` or URIs; a `Learner` also takes a run directory. A call waits up to `timeout_s` for a service
that is away, and raises `CallError`. Calls may be repeated, except those that begin or end a lease of a bridge or play
a motion. Messages are those of `proto/proto/tandem/v1`, whose comments describe their fields.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import pathlib
import threading
from collections.abc import Iterable, Iterator, Sequence
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tandem._grpc import Path, ServiceError, grpc, open_channel, parse_address, uses_tls
from tandem._proto import (
    bridge_pb2,
    bridge_pb2_grpc,
    learner_pb2,
    learner_pb2_grpc,
    teacher_pb2,
    teacher_pb2_grpc,
)
from tandem._task import Floats

__all__ = [
    "Account",
    "Advice",
    "ArmAdvice",
    "Bridge",
    "CallError",
    "Learner",
    "Lease",
    "MotionStopped",
    "Step",
    "Teacher",
    "WayPoint",
]

_TEMPORARY = frozenset({"UNAVAILABLE", "DEADLINE_EXCEEDED", "RESOURCE_EXHAUSTED", "ABORTED", "INTERNAL"})
_KEEP_ALIVE_S = 0.04
"""Time between two signs of life; the bridge requires one every 0.1 s."""
_REPORT_S = 5.0
"""The longest time between two reports of a motion, of which the bridge sends twenty per second."""
_STOP_S = 4.0
"""The longest wait for the confirmation of a stop, as in `tandem bridge stop`."""
_PROBE_S = 1.0
_STEP_S = 0.04
_RESET_S = 2.0
"""The longest time that a bridge waits before it refuses a reset."""

_ClientT = TypeVar("_ClientT", bound="_Client")


class CallError(ServiceError):
    """A call that failed, with the name of its gRPC status code."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.is_temporary = code in _TEMPORARY
        """Whether the same call may succeed later."""

    # Pickling would call the constructor with the message alone.
    def __reduce__(self) -> tuple[type[CallError], tuple[str, str]]:
        return type(self), (self.code, str(self))


class MotionStopped(ServiceError):
    """A motion that ended because the arms were stopped. `name` is the reason's code; docs/bridge.md lists them."""

    def __init__(self, name: str, sentence: str) -> None:
        super().__init__(f"the arms are stopped: {sentence}")
        self.name = name
        self._sentence = sentence

    def __reduce__(self) -> tuple[type[MotionStopped], tuple[str, str]]:
        return type(self), (self.name, self._sentence)


class _Client:
    """A channel to a service: a context manager that closes it."""

    def __init__(
        self,
        address: str,
        *,
        token_file: Path | None = None,
        tls_ca: Path | None = None,
        timeout_s: float = 10.0,
    ) -> None:
        self._address = address
        self._timeout_s = timeout_s
        self._is_plain = tls_ca is None
        self._channel = open_channel(address, token_file, tls_ca)

    def close(self) -> None:
        """Closes the channel. Open streams end."""
        self._channel.close()

    def __enter__(self: _ClientT) -> _ClientT:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _call(self, method: Any, request: Any, limit_s: float | None = None) -> Any:
        limit_s = limit_s or self._timeout_s
        with self._errors(limit_s):
            return method(request, timeout=limit_s, wait_for_ready=True)

    @contextlib.contextmanager
    def _errors(self, limit_s: float) -> Iterator[None]:
        try:
            yield
        except grpc.RpcError as error:
            raise CallError(error.code().name, f"{self._address}: {self._reason(error, limit_s)}") from error

    def _reason(self, error: grpc.RpcError, limit_s: float, connection_failure: str | None = None) -> str:
        """Returns why a call with this timeout failed. `connection_failure` is looked up unless it is known."""
        code, details = error.code().name, error.details() or ""
        if code == "DEADLINE_EXCEEDED":
            failure = self._connection_failure() if connection_failure is None else connection_failure
            return f"no answer within {limit_s:g} s{failure}"
        if code == "UNAVAILABLE":
            return f"{details}{self._tls_hint()}"
        # Servers of Tandem and of Python give no other reason for a call that they do not know.
        if code == "UNIMPLEMENTED" and details in ("", "Method not found!"):
            return self._wrong_service(error)
        return details

    def _wrong_service(self, error: grpc.RpcError) -> str:
        """Returns which service answered a call that it does not know, as far as it says so."""
        expected = type(self).__name__.lower()
        metadata = dict((*(error.initial_metadata() or ()), *(error.trailing_metadata() or ())))
        served = str(metadata.get("tandem-service", "")).rpartition(".")[2].lower()
        if served in ("", expected):
            return "the service does not know the call: it is of another kind or version"
        return f"the service is {served}, not {expected}: check the address"

    def _connection_failure(self) -> str:
        """Returns why there is no connection, after a colon; nothing if there is one."""
        try:
            # A call that does not wait for a connection fails with the reason why there is none.
            self._channel.unary_unary("/grpc.health.v1.Health/Check")(b"", timeout=_PROBE_S)
        except grpc.RpcError as error:
            if error.code() is grpc.StatusCode.UNAVAILABLE:
                return f": {error.details()}{self._tls_hint()}"
        return ""

    def _tls_hint(self) -> str:
        return "; it uses TLS: give tls_ca" if self._is_plain and uses_tls(self._address, _PROBE_S) else ""


@dataclasses.dataclass(frozen=True)
class Step:
    """A step for which a student asks for advice. Vectors of several arms are concatenated in arm order."""

    episode: int
    step: int
    """From 0."""
    observation: ArrayLike
    """Shape `[n_observation]`."""
    goal: ArrayLike
    """Shape `[n_goal]`."""
    proposed_action: ArrayLike
    """The student's action, in [-1, 1], shape `[n_action]`."""
    judged_action: ArrayLike | None = None
    """The action that the teacher judges in its place, shape `[n_action]`."""
    payer: int | None = None
    """The episode that pays; steps of a request with the same payer and step share one unit."""


@dataclasses.dataclass(frozen=True)
class ArmAdvice:
    """The teacher's opinion on one arm."""

    teacher_action: Floats
    """Shape `[n_action_per_arm]`."""
    q_teacher: float
    q_student: float
    importance: float
    """`q_teacher - q_student`."""
    distance: float
    """The Euclidean distance between the two actions."""
    overridden: bool


@dataclasses.dataclass(frozen=True)
class Advice:
    """The answer to one step."""

    action: Floats
    """The action to execute, shape `[n_action]`."""
    charged: bool
    """Whether the step cost a unit of the budget."""
    arms: tuple[ArmAdvice, ...]
    repeated: bool = False
    """Whether the step of this episode was decided before: the advice is the former one, whatever the observation."""


@dataclasses.dataclass(frozen=True)
class Account:
    """An account at a teacher, in units of advised steps."""

    name: str
    budget: int
    strategy: str
    spent: int
    leased: int
    left: int
    warning: str
    """The reason why the teacher's ledger cannot be written or its policy cannot be evaluated; empty if both can."""


class Teacher(_Client):
    """A client of `tandem teacher`.

    >>> with tandem.Teacher("127.0.0.1:7001") as teacher:
    ...     teacher.open_account("mine", budget=100, strategy="mc-q:0.1")
    ...     advice = teacher.advise("mine", [tandem.Step(0, 0, observation, goal, action)])
    """

    def __init__(self, address: str, **options: Any) -> None:
        super().__init__(address, **options)
        self._stub = teacher_pb2_grpc.TeacherStub(self._channel)

    def describe(self) -> teacher_pb2.DescribeResponse:
        """Returns the teacher's task, the layout of vectors and the available strategies."""
        response: teacher_pb2.DescribeResponse = self._call(self._stub.Describe, teacher_pb2.DescribeRequest())
        return response

    def open_account(self, name: str, *, budget: int, strategy: str) -> Account:
        """Opens an account, or returns the existing one with this name and these terms."""
        request = teacher_pb2.OpenAccountRequest(name=name, budget=budget, strategy=strategy)
        return _account(self._call(self._stub.OpenAccount, request))

    def account(self, name: str) -> Account:
        """Returns an account."""
        return _account(self._call(self._stub.GetAccount, teacher_pb2.GetAccountRequest(name=name)))

    def advise(self, account: str, steps: Iterable[Step]) -> list[Advice]:
        """Returns the advice on each step. A repeated step gets the same decision at no charge."""
        request = teacher_pb2.AdviseRequest(account=account)
        for step in steps:
            request.steps.add(
                episode=step.episode,
                step=step.step,
                observation=_floats(step.observation),
                goal=_floats(step.goal),
                proposed_action=_floats(step.proposed_action),
                judged_action=None if step.judged_action is None else _floats(step.judged_action),
                payer=step.payer,
            )
        return [_advice(step) for step in self._call(self._stub.Advise, request).steps]


def _floats(array: ArrayLike) -> Floats:
    return np.asarray(array, np.float32).ravel()


def _account(message: teacher_pb2.Account) -> Account:
    return Account(
        name=message.name,
        budget=message.budget,
        strategy=message.strategy,
        spent=message.spent,
        leased=message.leased,
        left=message.left,
        warning=message.warning,
    )


def _advice(message: teacher_pb2.StepAdvice) -> Advice:
    arms = (
        ArmAdvice(
            teacher_action=np.array(arm.teacher_action, np.float32),
            q_teacher=arm.q_teacher,
            q_student=arm.q_student,
            importance=arm.importance,
            distance=arm.distance,
            overridden=arm.overridden,
        )
        for arm in message.arms
    )
    return Advice(np.array(message.action, np.float32), message.charged, tuple(arms), message.repeated)


class Learner(_Client):
    """A client of `tandem learner`, at an address or of the `tandem train` that runs in a directory.

    >>> tandem.Learner("runs/first").status().env_steps

    >>> with tandem.Learner("127.0.0.1:7000") as learner:
    ...     for progress in learner.watch():
    ...         print(progress.env_steps, progress.training_success)
    """

    def __init__(self, address: Path, **options: Any) -> None:
        super().__init__(_learner_address(os.fspath(address)), **options)
        self._stub = learner_pb2_grpc.LearnerStub(self._channel)

    def status(self) -> learner_pb2.Progress:
        """Returns the progress of the run."""
        progress: learner_pb2.Progress = self._call(self._stub.Status, learner_pb2.StatusRequest())
        return progress

    def watch(self) -> Iterator[learner_pb2.Progress]:
        """Yields the progress about once per second. The last message has `ended` set.

        The stream itself has no deadline: it is opened once the learner has answered, as any call, within `timeout_s`.
        """
        self.status()
        with self._errors(self._timeout_s):
            stream = self._stub.Watch(learner_pb2.WatchRequest())
            try:
                for progress in stream:
                    yield progress
                    if progress.ended:
                        return
            finally:
                stream.cancel()
        raise CallError("UNAVAILABLE", f"{self._address}: the learner is gone before the end of the run")


def _learner_address(given: str) -> str:
    """Returns the address that is given, or that of the learner that runs in the directory that is given."""
    if not os.path.isdir(given):
        try:
            parse_address(given)
        except ServiceError as error:
            raise ServiceError(f"{error}, or a run directory") from None
        return given
    if not os.path.exists(os.path.join(given, "run.toml")):
        raise ServiceError(f"{given} holds no run")
    address = pathlib.Path(given, "in-use", "learner")
    # A `tandem train` that was killed has left the address, at which another program may listen now.
    if not address.exists() or not _is_locked(given):
        raise ServiceError(f"no learner of a `tandem train` is running in {given}")
    return address.read_text().strip()


def _is_locked(directory: str) -> bool:
    """Returns whether a process has locked a directory, as `tandem train` locks that of its run."""
    import fcntl  # Windows has none.

    descriptor = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)


@dataclasses.dataclass(frozen=True)
class WayPoint:
    """A position of one arm's tool."""

    tool_m: tuple[float, float, float]
    """x, y and z in the world frame, metres."""
    opening: float = 1.0
    """The opening of the gripper, 0 (closed) to 1 (open)."""


class Bridge(_Client):
    """A client of `tandem bridge`, which moves a pair of arms.

    >>> with tandem.Bridge("127.0.0.1:7002") as bridge, bridge.lease() as lease:
    ...     lease.reset()
    ...     lease.move([(tandem.WayPoint((-0.1, 0.02, 0.12)), tandem.WayPoint((0.1, -0.02, 0.12)))], speed=0.5)
    """

    def __init__(self, address: str, **options: Any) -> None:
        super().__init__(address, **options)
        self._stub = bridge_pb2_grpc.BridgeStub(self._channel)

    def describe(self) -> bridge_pb2.DescribeBridgeResponse:
        """Returns the model, the layout and the limits of the arms."""
        response: bridge_pb2.DescribeBridgeResponse = self._call(
            self._stub.Describe, bridge_pb2.DescribeBridgeRequest()
        )
        return response

    def status(self) -> bridge_pb2.BridgeStatusResponse:
        """Returns the state of the bridge and of the arms."""
        response: bridge_pb2.BridgeStatusResponse = self._call(self._stub.Status, bridge_pb2.BridgeStatusRequest())
        return response

    def stop(self) -> bridge_pb2.BridgeStop:
        """Stops the arms, at any time and without a lease. Returns the first reason since the last reset.

        Raises:
          CallError: if the arms have not confirmed the stop, after four seconds at most. Use the emergency stop then.
        """
        limit_s = min(self._timeout_s, _STOP_S)
        response: bridge_pb2.StopResponse
        connection_failure = ""
        try:
            call = self._stub.Stop.future(bridge_pb2.StopRequest(), timeout=limit_s, wait_for_ready=True)
            try:
                response = call.result(timeout=limit_s / 2)
            except grpc.FutureTimeoutError:
                # After the timeout of the call there would be no time left for this.
                connection_failure = self._connection_failure()
                response = call.result()
        except grpc.RpcError as error:
            reason = self._reason(error, limit_s, connection_failure)
            what = f"{self._address}: the stop is not confirmed, use the emergency stop: {reason}"
            raise CallError(error.code().name, what) from error
        return response.stopped

    def check(self, motion: bridge_pb2.MotionRequest) -> bridge_pb2.CheckResponse:
        """Checks a motion as if it started now. Nothing moves."""
        request = bridge_pb2.CheckRequest(motion=motion)
        response: bridge_pb2.CheckResponse = self._call(self._stub.Check, request)
        return response

    def inject(self, fault: str, *, arm: int = 0, joint: int = 1) -> list[bridge_pb2.FaultInjection]:
        """Injects a fault into simulated arms, to practise a stop, and returns the present ones. Real arms refuse it.

        `fault` is a name of `tandem bridge inject`, such as "emergency-stop"; `joint` counts from 1. No lease is needed.

        >>> bridge.inject("blocked-joint", arm=1, joint=2)
        >>> bridge.clear()
        """
        name = "INJECTED_FAULT_" + fault.upper().replace("-", "_")
        known = [name for name, number in bridge_pb2.InjectedFault.items() if number]
        if name not in known:
            names = [name.removeprefix("INJECTED_FAULT_").lower().replace("_", "-") for name in known]
            raise ValueError(f"fault is {fault!r}, expected one of {', '.join(names)}")
        number = bridge_pb2.InjectedFault.Value(name)
        request = bridge_pb2.InjectRequest(fault=bridge_pb2.FaultInjection(fault=number, arm=arm, joint=joint - 1))
        return self._injected(request)

    def clear(self) -> list[bridge_pb2.FaultInjection]:
        """Clears all injected faults, and returns the present ones: none."""
        return self._injected(bridge_pb2.InjectRequest(clear=bridge_pb2.ClearFaults()))

    def _injected(self, request: bridge_pb2.InjectRequest) -> list[bridge_pb2.FaultInjection]:
        response: bridge_pb2.InjectResponse = self._call(self._stub.Inject, request)
        return list(response.injected)

    @contextlib.contextmanager
    def lease(self) -> Iterator[Lease]:
        """Makes the caller the owner of the arms within a `with` block."""
        token = self._call(self._stub.Acquire, bridge_pb2.AcquireRequest()).token
        try:
            yield Lease(self, token)
        finally:
            with contextlib.suppress(CallError):
                self._call(self._stub.Release, bridge_pb2.ReleaseRequest(token=token))


def motion(
    way_points: Sequence[Sequence[WayPoint]], *, speed: float, from_here: bool = True, step_s: float = _STEP_S
) -> bridge_pb2.MotionRequest:
    """Returns a motion through `way_points`, each with one entry per arm.

    `speed` is the fraction of the motion's own speed, in (0, 1]; `from_here` inserts the current positions first;
    `step_s` is the minimum time between waypoints, seconds.
    """
    request = bridge_pb2.MotionRequest(speed=speed)
    request.way_points.step_s = step_s
    request.way_points.from_here = from_here
    for arms in way_points:
        way_point = request.way_points.way_points.add()
        for arm in arms:
            way_point.arms.add(tool_in_world_m=arm.tool_m, opening=arm.opening)
    return request


class Lease:
    """Ownership of the arms of a bridge."""

    def __init__(self, bridge: Bridge, token: str) -> None:
        self._bridge = bridge
        self._token = token

    def reset(self) -> None:
        """Releases stopped arms, so that they accept motions. Inspect the arms first. Idle arms stay as they are.

        The bridge waits up to two seconds for arms that still brake, and for good states.

        Raises:
          CallError: if the bridge refuses the reset. If the arms were stopped or had a fault meanwhile, inspect them
            again.
        """
        request = bridge_pb2.ResetRequest(token=self._token)
        self._bridge._call(self._bridge._stub.Reset, request, self._bridge._timeout_s + _RESET_S)

    def renew(self) -> None:
        """Renews the lease, which otherwise ends some seconds after the last request."""
        self._bridge._call(self._bridge._stub.Acquire, bridge_pb2.AcquireRequest(token=self._token))

    def move(
        self,
        way_points: Sequence[Sequence[WayPoint]],
        *,
        speed: float,
        from_here: bool = True,
        step_s: float = _STEP_S,
    ) -> bridge_pb2.MotionProgress:
        """Plays a motion through `way_points` (see `motion`) to its end, and returns the last report.

        Raises:
          CallError: if the bridge refuses the motion.
          MotionStopped: if the arms were stopped before the end.
        """
        progress = bridge_pb2.MotionProgress()
        for progress in self.play(motion(way_points, speed=speed, from_here=from_here, step_s=step_s)):
            pass
        return progress

    def play(self, motion: bridge_pb2.MotionRequest) -> Iterator[bridge_pb2.MotionProgress]:
        """Plays a motion, and yields about twenty reports per second. If the iterator is closed, the arms stop.

        Raises:
          CallError: if the bridge refuses the motion, or sends no report within five seconds (for the first one, within
            `timeout_s`).
          MotionStopped: if the arms were stopped before the end.
        """
        ended = threading.Event()

        def requests() -> Iterator[bridge_pb2.ExecuteRequest]:
            yield bridge_pb2.ExecuteRequest(start=bridge_pb2.ExecuteStart(token=self._token, motion=motion))
            while not ended.wait(_KEEP_ALIVE_S):
                yield bridge_pb2.ExecuteRequest(alive=bridge_pb2.SignOfLife())

        with self._bridge._errors(self._bridge._timeout_s):
            responses = self._bridge._stub.Execute(requests())
            limit_s = self._bridge._timeout_s  # As for any call: the bridge checks the motion first.
            try:
                while (response := self._next_report(responses, limit_s)) is not None:
                    limit_s = _REPORT_S
                    yield response.progress
                    if response.HasField("outcome"):
                        if response.outcome.HasField("stopped"):
                            stopped = response.outcome.stopped
                            raise MotionStopped(stopped.name, stopped.sentence)
                        return
            finally:
                ended.set()
                responses.cancel()
        raise CallError("UNAVAILABLE", f"{self._bridge._address}: the stream of the motion ended early")

    def _next_report(self, responses: Any, limit_s: float) -> bridge_pb2.ExecuteResponse | None:
        """Returns the next report, or None after the last one. If none arrives in time, the stream is cancelled."""
        too_late = threading.Event()

        def cancel() -> None:
            too_late.set()
            responses.cancel()

        timer = threading.Timer(limit_s, cancel)
        timer.daemon = True
        timer.start()
        response = None
        try:
            response = next(responses, None)
        except grpc.RpcError:
            if not too_late.is_set():
                raise
        finally:
            timer.cancel()
        if too_late.is_set():
            what = f"no report of the motion within {limit_s:g} s{self._bridge._connection_failure()}"
            advice = "the arms may be moving: stop them, with the emergency stop if that is not confirmed"
            raise CallError("DEADLINE_EXCEEDED", f"{self._bridge._address}: {what}; {advice}")
        return response
