"""Finds the description of a Gymnasium environment's task by playing in it."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tandem._failures import Raised
from tandem._grpc import ServiceError
from tandem._task import Arm, Manipulation, Norm, Reflection, Task, distance

DEFAULT_BOUND = 1000.0
"""The bound of numbers for which the environment's space has none."""
TOLERANCE_ERROR = 1e-3
"""The largest relative error of a measured tolerance, which has four significant digits."""
_KEYS = ("observation", "achieved_goal", "desired_goal")
_PROBE_EPISODES = 8
_PROBE_STEPS = 10


@dataclasses.dataclass(frozen=True)
class TaskOptions:
    """What a caller may say about an environment's task; everything else is found by probing the environment."""

    name: str | None = None
    arms: Sequence[Arm] | None = None
    achieved_goal: Sequence[int] | None = None
    interchangeable_arms: bool = False
    origin_distance: float = 0.0
    recombination_gap: float = 0.0
    base: float = 0.0
    contact_distances: Sequence[float] = ()
    manipulation: Manipulation = Manipulation()
    reflection: Reflection = Reflection()
    reports_contacts: bool = False
    tolerance: float | None = None
    norm: Norm | None = None
    episode_steps: int | None = None
    goal_bound: Sequence[float] | None = None
    bound: float = DEFAULT_BOUND

    @classmethod
    def combined(cls, env: gymnasium.Env[Any, Any], given: dict[str, Any]) -> TaskOptions:
        """Returns the options that are given, and for the others those in `tandem_task` of the environment."""
        own = dict(_attribute(env, "tandem_task") or {})
        unknown = set(own) - {field.name for field in dataclasses.fields(cls)}
        if unknown:
            raise ServiceError(f"the environment's tandem_task has unknown items: {', '.join(sorted(unknown))}")
        return cls(**{**own, **{name: value for name, value in given.items() if value is not None}})


class UnusableEnvironment(ServiceError):
    """An environment that raised an exception, which is the cause."""


@contextlib.contextmanager
def environment_errors() -> Iterator[None]:
    """Converts the errors of an environment that cannot be used to `ServiceError`."""
    try:
        yield
    except ServiceError:
        raise
    except (Exception, SystemExit) as error:  # Environments raise errors of their own.
        raise UnusableEnvironment(f"the environment cannot be used: {Raised.of(error).text}") from error


def describe(env: gymnasium.Env[Any, Any], options: TaskOptions) -> tuple[Task, bool]:
    """Returns the task of `env`, and whether the achieved goal has to be appended to its observations.

    Plays a few short episodes, to find the achieved goal within the observation and to compare the environment's
    reward with the sparse reward of the description.
    """
    if not (np.isfinite(options.bound) and options.bound > 0):
        raise ServiceError(f"the bound must be a positive number, not {options.bound}")
    spaces, action = _checked_spaces(env)
    samples = _probe(env)
    has_several_arms = options.arms is not None and len(options.arms) > 1
    if options.reports_contacts and has_several_arms and "arm_contact" not in samples[-1].info:
        raise ServiceError("reports_contacts: the infos of the environment's steps have no arm_contact")
    found = _find_achieved_goal(samples)
    if options.achieved_goal is not None:
        found = _checked_achieved_goal(samples, options.achieved_goal)
    n_goal = int(spaces["achieved_goal"].shape[0])
    n_own = int(spaces["observation"].shape[0])
    indices = tuple(range(n_own, n_own + n_goal)) if found is None else found
    tolerance = options.tolerance if options.tolerance is not None else _tolerance(env, samples)
    n_action = int(action.shape[0])
    arms = options.arms
    if arms is None:
        n_observation = n_own + (n_goal if found is None else 0)
        arms = (Arm(tuple(range(n_observation)), tuple(range(n_goal)), tuple(range(n_action))),)
    elif found is None:
        # The appended numbers belong to the arms of their goals.
        with_goal = (tuple(arm.observation) + tuple(n_own + goal for goal in arm.goal) for arm in arms)
        arms = tuple(dataclasses.replace(arm, observation=own) for arm, own in zip(arms, with_goal))
    bounds = _bounds(spaces["observation"], options.bound)
    goal_bound = _bounds(spaces["desired_goal"], options.bound) if options.goal_bound is None else options.goal_bound
    if found is None:
        bounds += _bounds(spaces["achieved_goal"], options.bound)
    task = Task(
        name=_name(env, options.name),
        n_observation=len(bounds),
        n_goal=n_goal,
        n_action=n_action,
        arms=arms,
        achieved_goal=indices,
        episode_steps=_episode_steps(env, options.episode_steps),
        tolerance=tolerance,
        norm=_checked_norm(env, samples, tolerance, options.norm),
        interchangeable_arms=options.interchangeable_arms,
        reports_contacts=options.reports_contacts,
        observation_bound=bounds,
        goal_bound=goal_bound,
        origin_distance=options.origin_distance,
        recombination_gap=options.recombination_gap,
        base=options.base,
        contact_distances=options.contact_distances,
        manipulation=options.manipulation,
        reflection=options.reflection,
    )
    _check_arms(task)
    task.check()
    return task, found is None


def appends_goal(env: gymnasium.Env[Any, Any], task: Task) -> bool:
    """Returns whether the achieved goal has to be appended to the observations of `env`, given the task's description.

    Raises:
        ServiceError: The environment cannot be served, or not with the vectors of `task`.
    """
    spaces, action = _checked_spaces(env)
    n_own, n_goal = (int(spaces[key].shape[0]) for key in ("observation", "achieved_goal"))
    appends = n_own < task.n_observation and tuple(task.achieved_goal) == tuple(range(n_own, n_own + n_goal))
    found = (n_own + n_goal if appends else n_own, n_goal, int(action.shape[0]))
    expected = (task.n_observation, task.n_goal, task.n_action)
    for name, length, its in zip(("observation", "goal", "action"), found, expected):
        if length != its:
            difference = f"{name} of length {length}, not {its}"
            raise ServiceError(f"the environment is not that of task {task.name!r}: {difference}")
    return appends


def _checked_spaces(env: gymnasium.Env[Any, Any]) -> tuple[Any, gymnasium.spaces.Box]:
    space, action = env.observation_space, env.action_space
    if not isinstance(space, gymnasium.spaces.Dict) or not set(_KEYS) <= set(space.spaces):
        raise ServiceError(f"the observation space must be a Dict with {', '.join(_KEYS)}; it is {space}")
    for key in _KEYS:
        if not isinstance(space[key], gymnasium.spaces.Box) or len(space[key].shape or ()) != 1:
            raise ServiceError(f"the space of {key} must be a Box with one dimension; it is {space[key]}")
    if not isinstance(action, gymnasium.spaces.Box) or len(action.shape) != 1 or not action.is_bounded("both"):
        raise ServiceError(f"the action space must be a bounded Box with one dimension; it is {action}")
    if space["achieved_goal"].shape != space["desired_goal"].shape:
        raise ServiceError("achieved and desired goals differ in length")
    return space, action


@dataclasses.dataclass
class _Sample:
    observation: dict[str, NDArray[Any]]
    info: dict[str, Any]


def _probe(env: gymnasium.Env[Any, Any]) -> list[_Sample]:
    """Plays random actions from several starts."""
    random = np.random.default_rng(0)
    space = env.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    samples = []
    for seed in range(_PROBE_EPISODES):
        observation, info = env.reset(seed=seed)
        samples.append(_Sample(_checked(observation, env.observation_space), info))
        goal = samples[-1].observation["desired_goal"]
        for _ in range(_PROBE_STEPS):
            action = random.uniform(space.low, space.high).astype(space.dtype)
            observation, _, _, _, info = env.step(action)
            samples.append(_Sample(_checked(observation, env.observation_space), info))
            if not np.array_equal(samples[-1].observation["desired_goal"], goal):
                raise ServiceError("desired_goal changes within an episode: an episode has one goal")
    return samples


def _checked(observation: dict[str, Any], space: Any) -> dict[str, NDArray[Any]]:
    """Returns a copy of an observation whose parts have the shapes of their spaces and finite numbers."""
    copied = {key: np.array(observation[key]) for key in _KEYS}
    for key, numbers in copied.items():
        if numbers.shape != space[key].shape:
            raise ServiceError(f"{key} has shape {list(numbers.shape)}, its space {list(space[key].shape)}")
        if not np.isfinite(numbers).all():
            index = int(np.argmin(np.isfinite(numbers)))
            raise ServiceError(f"{key}[{index}] is {numbers[index]}, expected a finite number")
    return copied


def _find_achieved_goal(samples: list[_Sample]) -> tuple[int, ...] | None:
    """Returns the indices of the achieved goal in the observation; `None` if it is not contained.

    A run of consecutive indices is preferred. An index whose number never changed is accepted within such a run only,
    because equal constants prove nothing.
    """
    observations = np.stack([sample.observation["observation"] for sample in samples]).astype(np.float32)
    achieved = np.stack([sample.observation["achieved_goal"] for sample in samples]).astype(np.float32)
    n_goal = achieved.shape[1]
    changes = (achieved != achieved[0]).any(axis=0)
    if not changes.any():
        return None
    for start in range(observations.shape[1] - n_goal + 1):
        if np.array_equal(observations[:, start : start + n_goal], achieved):
            return tuple(range(start, start + n_goal))
    if not changes.all():
        return None
    indices: list[int] = []
    for column in achieved.T:
        matches = np.flatnonzero((observations == column[:, None]).all(axis=0))
        unused = [int(index) for index in matches if index not in indices]
        if not unused:
            return None
        indices.append(unused[0])
    return tuple(indices)


def _checked_achieved_goal(samples: list[_Sample], indices: Sequence[int]) -> tuple[int, ...]:
    """Returns the given indices of the achieved goal in the observation, if it is there in every sample."""
    for sample in samples:
        observation, achieved = sample.observation["observation"], sample.observation["achieved_goal"]
        if len(indices) != len(achieved) or any(not 0 <= index < len(observation) for index in indices):
            limits = f"{len(achieved)} indices from 0 to {len(observation) - 1}"
            raise ServiceError(f"achieved_goal: expected {limits}, got {list(indices)}")
        if not np.array_equal(observation[list(indices)].astype(np.float32), achieved.astype(np.float32)):
            raise ServiceError(f"the observation does not have the achieved goal at {list(indices)}")
    return tuple(indices)


def _attribute(env: gymnasium.Env[Any, Any], name: str) -> Any:
    """Returns an attribute of the environment, or of its `task` as in panda-gym; `None` if there is none."""
    try:
        return env.get_wrapper_attr(name)
    except AttributeError:
        return getattr(getattr(env.unwrapped, "task", None), name, None)


def _tolerance(env: gymnasium.Env[Any, Any], samples: list[_Sample]) -> float:
    """Returns the environment's own tolerance, or measures the distance at which its reward changes.

    A measured tolerance has four significant digits.
    """
    threshold = _attribute(env, "distance_threshold")
    compute_reward = _attribute(env, "compute_reward")
    if threshold is not None or compute_reward is None:
        return float(threshold or 0.0)
    for sample in samples:
        goals = sample.observation["achieved_goal"], sample.observation["desired_goal"]
        _sparse_reward(compute_reward, *goals, sample.info)
    achieved = samples[0].observation["achieved_goal"].astype(np.float64)

    def is_achieved(distance: float) -> bool:
        desired = achieved.copy()
        desired[0] += distance
        return _sparse_reward(compute_reward, achieved, desired, samples[0].info) == 0.0

    low, high = 0.0, 1e-6
    while is_achieved(high) and high < 1e6:
        low, high = high, 2 * high
    if low == 0.0 or is_achieved(high):
        raise ServiceError("the reward does not change with the distance of a goal: give the tolerance")
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if is_achieved(middle) else (low, middle)
    return float(f"{low:.4g}")


def _episode_steps(env: gymnasium.Env[Any, Any], given: int | None) -> int:
    own = None if env.spec is None else env.spec.max_episode_steps
    steps = own if given is None else given
    if steps is None:
        raise ServiceError("the environment's spec has no max_episode_steps: give episode_steps")
    if not 1 <= steps <= 10_000:
        raise ServiceError(f"an episode has 1 to 10000 steps, not {steps}")
    return steps


def _name(env: gymnasium.Env[Any, Any], given: str | None) -> str:
    if given is not None:
        if not re.fullmatch(r"[a-z0-9._/-]{1,64}", given):
            raise ServiceError(f"{given!r} is not a name: expected 1 to 64 of a-z, 0-9, '-', '_', '.' and '/'")
        return given
    own = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    return re.sub(r"[^a-z0-9._/-]", "-", own.lower())[:64]


def _bounds(space: gymnasium.spaces.Box, default: float) -> list[float]:
    """Returns the largest magnitude of each number of `space`, or `default` where it is unbounded or always 0."""
    magnitude = np.maximum(np.abs(space.low), np.abs(space.high)).astype(np.float64)
    # Spaces without a real bound have the largest number of their type instead of infinity.
    magnitude[(magnitude > np.finfo(np.float32).max / 2) | (magnitude == 0)] = default
    return [float(bound) for bound in magnitude]


def _checked_norm(
    env: gymnasium.Env[Any, Any], samples: list[_Sample], tolerance: float, given: Norm | None
) -> Norm:
    """Returns the norm for which the environment's reward is -1 beyond the tolerance and 0 within it."""
    compute_reward = _attribute(env, "compute_reward")
    if compute_reward is None:
        raise ServiceError("the environment has no compute_reward(achieved_goal, desired_goal, info)")
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise ServiceError(f"the tolerance must be a positive number, not {tolerance}")
    rewards = []
    for achieved, desired, info in _goal_pairs(samples, tolerance):
        rewards.append((achieved, desired, _sparse_reward(compute_reward, achieved, desired, info)))
    norms: list[Norm] = ["euclidean", "maximum"] if given is None else [given]
    refusals = [_disagreement(norm, tolerance, rewards) for norm in norms]
    for norm, refusal in zip(norms, refusals):
        if refusal is None:
            return norm
    raise ServiceError(str(refusals[0]))


def _sparse_reward(
    compute_reward: Any, achieved: NDArray[Any], desired: NDArray[Any], info: dict[str, Any]
) -> float:
    """Returns the reward less that at the goal, -1 or 0: the rewards of an environment are -1 and 0, or 0 and 1."""
    reward, at_goal = (float(compute_reward(achieved, goal, info)) for goal in (desired, achieved.copy()))
    if at_goal not in (0.0, 1.0) or reward - at_goal not in (-1.0, 0.0):
        raise ServiceError(
            f"the reward is not sparse: compute_reward returned {reward:g}, and {at_goal:g} at the goal, expected -1 "
            "and 0, or 0 and 1 (many environments take reward_type=\"sparse\")"
        )
    return reward - at_goal


def _goal_pairs(
    samples: list[_Sample], tolerance: float
) -> list[tuple[NDArray[Any], NDArray[Any], dict[str, Any]]]:
    """Returns the goals of the samples, and goals at distances below and above the tolerance."""
    random = np.random.default_rng(1)
    pairs = [(s.observation["achieved_goal"], s.observation["desired_goal"], s.info) for s in samples]
    for sample in samples[::3]:
        achieved = sample.observation["achieved_goal"]
        for norm in (2, np.inf):
            for factor in (0.0, 0.3, 0.7, 0.99, 1.01, 1.3, 2.0, 10.0):
                direction = random.normal(size=achieved.shape)
                offset = direction / np.linalg.norm(direction, norm) * tolerance * factor
                pairs.append((achieved, (achieved + offset).astype(achieved.dtype), sample.info))
    return pairs


def _disagreement(
    norm: Norm, tolerance: float, rewards: list[tuple[NDArray[Any], NDArray[Any], float]]
) -> str | None:
    for achieved, desired, reward in rewards:
        apart = distance(norm, achieved, desired)
        expected = 0.0 if apart <= tolerance else -1.0
        if reward != expected and abs(apart - tolerance) > TOLERANCE_ERROR * tolerance:
            said, is_at = ("achieved", "beyond") if reward == 0.0 else ("not achieved", "within")
            return (
                f"by compute_reward a goal at {norm} distance {apart:.4g} is {said}, {is_at} the tolerance "
                f"{tolerance:g}: give the environment's own tolerance and norm"
            )
    return None


def _check_arms(task: Task) -> None:
    if not 1 <= len(task.arms) <= 8:
        raise ServiceError(f"a task has 1 to 8 arms, not {len(task.arms)}")
    for kind, length in (("observation", task.n_observation), ("goal", task.n_goal), ("action", task.n_action)):
        parts = [list(getattr(arm, kind)) for arm in task.arms]
        flat = [index for part in parts for index in part]
        if len({len(part) for part in parts}) != 1:
            raise ServiceError(f"the arms' parts of the {kind} differ in length")
        if any(not 0 <= index < length for index in flat) or len(set(flat)) != len(flat):
            raise ServiceError(f"the arms' indices of the {kind} must be different numbers from 0 to {length - 1}")
