"""Policies of any origin as a server of `tandem.v1.Policy`, which a teacher consults."""

from __future__ import annotations

import hashlib
import re
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tandem._environments import check_actions, decode_floats, run
from tandem._failures import Raised, Tracebacks
from tandem._grpc import Path, Refused, Server, ServiceError, grpc
from tandem._gym import ACTION_SLACK
from tandem._proto import policy_pb2, policy_pb2_grpc
from tandem._task import Floats, Task
from tandem.policy import Policy

PolicyFn = Callable[[Floats, Floats], ArrayLike]
"""Returns actions, shape `[m, n_action]`, for observations `[m, n_observation]` and goals `[m, n_goal]`."""
ValueFn = Callable[[Floats, Floats, Floats], ArrayLike]
"""Returns the values, shape `[m]`, of actions `[m, n_action]` in these states."""

MAX_STATES = 256
"""The largest number of states of a request."""
_N_FINGERPRINT = 64


def _functions(policy: Policy) -> tuple[PolicyFn, ValueFn | None]:
    """Returns the actor and the critic, if it has one, of a policy from a file."""

    def inputs(observations: Floats, goals: Floats) -> dict[str, Floats]:
        return {"observation": observations, "desired_goal": goals}

    def act(observations: Floats, goals: Floats) -> ArrayLike:
        return policy.predict(inputs(observations, goals), deterministic=True)[0]

    def value(observations: Floats, goals: Floats, actions: Floats) -> ArrayLike:
        return policy.q(inputs(observations, goals), actions)

    return act, value if policy.has_critic else None


class PolicyFailure(Exception):
    """An exception of a policy, which is `raised`, or an answer of it that cannot be used."""

    def __init__(self, text: str, raised: Raised | None = None) -> None:
        super().__init__(text)
        self.raised = raised


class _Policy:
    """A policy with its task. Each state is evaluated alone unless `is_batched`."""

    def __init__(self, act: PolicyFn, value: ValueFn | None, task: Task, is_batched: bool) -> None:
        self._act = act
        self._value = value
        self._task = task
        self._is_batched = is_batched
        self.has_values = value is not None

    def act(self, observations: Floats, goals: Floats) -> Floats:
        """Returns actions in [-1, 1], shape `[m, n_action]`."""
        shape = (self._task.n_action,)
        actions = self._rows("the policy", self._act, shape, observations, goals)
        within = np.abs(actions) <= 1 + ACTION_SLACK
        if not within.all():
            number = actions[~within][0]
            raise PolicyFailure(f"the policy returned {number:g}, expected numbers in [-1, 1]: clip its actions")
        return np.clip(actions, -1, 1)

    def value(self, observations: Floats, goals: Floats, actions: Floats) -> Floats:
        """Returns the values of actions, shape `[m]`."""
        assert self._value is not None
        values = self._rows("the value function", self._value, (), observations, goals, actions)
        if not np.isfinite(values).all():
            raise PolicyFailure("the value function returned a number that is not finite")
        return values

    def _rows(self, name: str, function: Callable[..., ArrayLike], shape: tuple[int, ...], *inputs: Floats) -> Floats:
        """Applies `function` to all rows; to one at a time if its rows could depend on each other."""
        n_rows = len(inputs[0])
        size = max(n_rows, 1) if self._is_batched else 1
        parts = []
        for start in range(0, n_rows, size):
            rows = [array[start : start + size] for array in inputs]
            n = len(rows[0])
            try:
                answer = np.asarray(function(*rows), np.float32)
            except Exception as error:
                raised = Raised.of(error)
                raise PolicyFailure(f"{name} raised {raised.text}", raised) from error
            if answer.size != n * int(np.prod(shape)) or answer.shape[:1] != (n,):
                expected = list((n, *shape))
                raise PolicyFailure(f"{name} returned an array of shape {list(answer.shape)}, expected {expected}")
            parts.append(answer.reshape(n, *shape))
        return np.concatenate(parts) if parts else np.zeros((0, *shape), np.float32)


def fingerprint(policy: _Policy, task: Task) -> str:
    """Returns SHA-256 of the task's name and lengths and of the policy's answers in fixed states, hexadecimal.

    The states are drawn from a standard normal distribution.
    """
    random = np.random.default_rng(0)

    def draw(length: int) -> Floats:
        return random.standard_normal((_N_FINGERPRINT, length)).astype(np.float32)

    observations, goals = draw(task.n_observation), draw(task.n_goal)
    proposed = np.clip(draw(task.n_action), -1, 1)

    def answers() -> bytes:
        own = policy.act(observations, goals)
        parts = [own]
        if policy.has_values:
            parts += [policy.value(observations, goals, actions) for actions in (own, proposed)]
        return b"".join(part.astype("<f4").tobytes() for part in parts)

    first = answers()
    if answers() != first:
        raise ServiceError("the policy is not a function: it answers the same states differently (turn sampling off)")
    lengths = f"{task.name} {task.n_observation} {task.n_goal} {task.n_action} {int(policy.has_values)}\n"
    return hashlib.sha256(lengths.encode() + first).hexdigest()


class _Servicer(policy_pb2_grpc.PolicyServicer):
    """The service `tandem.v1.Policy`."""

    def __init__(self, policy: _Policy, task: Task, name: str, digest: str) -> None:
        self._policy = policy
        self._task = task
        self._name = name
        self._digest = digest
        self._lock = threading.Lock()  # Policies need not be thread-safe.
        self._tracebacks = Tracebacks()

    def Describe(self, request: Any, context: Any) -> policy_pb2.PolicyDescription:
        return policy_pb2.PolicyDescription(
            task=self._task.to_message(),
            name=self._name,
            digest=self._digest,
            has_values=self._policy.has_values,
        )

    def Evaluate(self, request: policy_pb2.EvaluatePolicyRequest, context: Any) -> policy_pb2.EvaluatePolicyResponse:
        try:
            with self._lock:
                return self._evaluate(request)
        except Refused as error:
            context.abort(error.code, str(error))
        except PolicyFailure as error:
            self._tracebacks.print(error, error.raised)
            context.abort(grpc.StatusCode.INTERNAL, str(error))
        raise AssertionError("abort raises")

    def _evaluate(self, request: policy_pb2.EvaluatePolicyRequest) -> policy_pb2.EvaluatePolicyResponse:
        if request.digest not in ("", self._digest):
            message = f"this server has policy {self._digest}, not {request.digest}"
            raise Refused(grpc.StatusCode.FAILED_PRECONDITION, message)
        task, policy = self._task, self._policy
        m = len(request.observations) // (4 * task.n_observation)
        if m > MAX_STATES:
            message = f"observations: expected at most {MAX_STATES} states, got {m}"
            raise Refused(grpc.StatusCode.INVALID_ARGUMENT, message)
        observations = _decode_finite("observations", request.observations, m, task.n_observation)
        goals = _decode_finite("goals", request.goals, m, task.n_goal)
        actions = policy.act(observations, goals)
        response = policy_pb2.EvaluatePolicyResponse(actions=_encode(actions))
        if policy.has_values:
            response.values = _encode(policy.value(observations, goals, actions))
        if request.actions:
            proposed = decode_floats("actions", request.actions, m, task.n_action)
            check_actions("actions", proposed)
            if policy.has_values:
                response.proposed_values = _encode(policy.value(observations, goals, proposed))
        return response


def _encode(array: Floats) -> bytes:
    return array.astype("<f4").tobytes()


def _decode_finite(field: str, data: bytes, n_rows: int, n_columns: int) -> Floats:
    numbers = decode_floats(field, data, n_rows, n_columns)
    if not np.isfinite(numbers).all():
        index = int(np.flatnonzero(~np.isfinite(numbers))[0])
        message = f"{field}[{index}]: expected a finite number, got {numbers.ravel()[index]:g}"
        raise Refused(grpc.StatusCode.INVALID_ARGUMENT, message)
    return numbers


class PolicyServer(Server):
    """A running server of a policy: a context manager, with its address in `address` and `digest` of the policy."""

    def __init__(
        self,
        policy: Policy | PolicyFn,
        *,
        task: str | Task | None = None,
        value: ValueFn | None = None,
        name: str | None = None,
        digest: str | None = None,
        batched: bool = False,
        listen: str = "127.0.0.1:0",
        token_file: Path | None = None,
        tls_cert: Path | None = None,
        tls_key: Path | None = None,
        insecure: bool = False,
    ) -> None:
        shown = name or str(getattr(policy, "__name__", type(policy).__name__))
        if isinstance(policy, Policy):
            if policy.n_arms != 1:
                raise ServiceError(f"a teacher's policy drives 1 arm, this one drives {policy.n_arms}")
            task, batched = task or Task.of_policy(policy), True
            # The file's digest does not identify other values.
            digest = digest or (policy.digest if value is None else None)
            policy, own_value = _functions(policy)
            value = own_value if value is None else value
        if task is None:
            raise ServiceError("give the task of the policy: the name of a built-in one, such as shared-push, or a Task")
        self.task = Task.built_in(task) if isinstance(task, str) else task
        self.task.check()
        if len(self.task.arms) != 1:
            raise ServiceError(f"a teacher's policy drives 1 arm, the task has {len(self.task.arms)}")
        served = _Policy(policy, value, self.task, batched)
        try:
            found = fingerprint(served, self.task)
        except PolicyFailure as error:
            raise ServiceError(f"the policy cannot be served: {error}") from error
        self.digest = found if digest is None else digest
        if not re.fullmatch(r"[A-Za-z0-9._:-]{1,128}", self.digest):
            raise ServiceError(f"{digest!r} is not a digest: expected 1 to 128 letters, digits, '-', '_', '.' and ':'")
        servicer = _Servicer(served, self.task, shown, self.digest)
        super().__init__(
            lambda server: policy_pb2_grpc.add_PolicyServicer_to_server(servicer, server),
            listen=listen,
            token_file=token_file,
            tls_cert=tls_cert,
            tls_key=tls_key,
            insecure=insecure,
        )


def serve_policy(
    policy: Policy | PolicyFn, *, task: str | Task | None = None, listen: str = "127.0.0.1:0", **options: Any
) -> None:
    """Serves a policy until the process is asked to end, by SIGINT or SIGTERM.

    Prints `listening on http://HOST:PORT` once it serves.

    Arguments:
      policy: a one-arm policy of `tandem.load_policy`, which needs no other argument; or a function of observations,
        shape `[m, n_observation]`, and goals, shape `[m, n_goal]`, that returns actions in [-1, 1], shape
        `[m, n_action]`; all float32.
      task: the name of a built-in task, such as `shared-push`, or a `tandem.Task` of one arm.
      value: a function of observations, goals and actions, shape `[m, n_action]`, that returns values, shape `[m]`;
        without it and without the critic of a policy file, strategies that compare values are not available.
      name: the name of the policy in logs.
      digest: identifies the policy, 1 to 128 letters, digits, `-`, `_`, `.` and `:`; by default
        that of its file, or a hash of its answers in 64 fixed states if it is a function or has values of its own.
      batched: whether to evaluate all states of a request at once. By default m is 1, so an answer does not depend on
        the other states of a request, as the last bits of matrix products do.
      token_file, tls_cert, tls_key, insecure: as the options of the same names of Tandem's services.

    Raises:
      ServiceError: if the policy cannot be used, or the address cannot be served.
    """
    run(lambda: PolicyServer(policy, task=task, listen=listen, **options))
