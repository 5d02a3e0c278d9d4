"""One Gymnasium environment with the vectors of its task."""

from __future__ import annotations

import contextlib
import importlib
import pathlib
from collections.abc import Callable
from typing import Any, SupportsFloat, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tandem._describe import TOLERANCE_ERROR
from tandem._failures import is_in_own_code
from tandem._grpc import ServiceError
from tandem._task import Floats, Task, distance
from tandem.panda import corrected

EnvFn = str | tuple[str, dict[str, Any]] | Callable[[], gymnasium.Env[Any, Any]]
"""An id for `gymnasium.make`, an id with arguments, or a function that creates an environment."""

_PACKAGES = ("gymnasium_robotics", "panda_gym")
"""Packages that register environments when they are imported."""


def make(env_fn: EnvFn) -> gymnasium.Env[Any, Any]:
    """Creates an environment from its id or its constructor."""
    return corrected(_make(env_fn))


def _make(env_fn: EnvFn) -> gymnasium.Env[Any, Any]:
    if callable(env_fn):
        return env_fn()
    name, kwargs = (env_fn, {}) if isinstance(env_fn, str) else env_fn
    file, _, env_id = name.partition(":")
    if file.endswith(".py"):
        parts = pathlib.PurePath(file).with_suffix("").parts
        module = ".".join(parts) if all(part.isidentifier() for part in parts) else parts[-1]
        expected = f"MODULE:ID, such as {module}:{env_id or 'Reach-v0'}, with an id that the module registers"
        raise ServiceError(f"{name!r} names a file: expected {expected}")
    try:
        try:
            return gymnasium.make(name, **kwargs)
        except (gymnasium.error.NameNotFound, gymnasium.error.NamespaceNotFound, gymnasium.error.VersionNotFound):
            for package in _PACKAGES:
                with contextlib.suppress(ImportError):
                    importlib.import_module(package)
        return gymnasium.make(name, **kwargs)
    except (gymnasium.error.UnregisteredEnv, ImportError) as error:
        raise ServiceError(f"no environment {name!r}: {error}; MODULE:ID imports a module first") from error
    except (gymnasium.error.Error, TypeError, ValueError) as error:
        if is_in_own_code(error):
            raise
        raise ServiceError(f"cannot create environment {name!r}: {error}") from error


ACTION_SLACK = 1e-6
"""The distance by which rounding may move an action out of [-1, 1]."""


def first_outside(actions: Floats) -> int | None:
    """Returns the index of the first number of actions that is not in [-1, 1], in row-major order."""
    # Written so that NaN fails the comparison.
    within = np.abs(actions.ravel()) <= 1 + ACTION_SLACK
    return None if within.all() else int(np.argmin(within))


class InvalidEpisode(ServiceError):
    """An environment breaks a rule of episodes. Playing the same episode again would give the same result."""


class GymEnvironment:
    """A Gymnasium environment with the vectors of its task, for servers and `tandem.ServedEnv`."""

    def __init__(self, env: gymnasium.Env[Any, Any], task: Task, appends_goal: bool) -> None:
        self._env = env
        self._task = task
        self._appends_goal = appends_goal
        self._bounds = np.asarray(task.observation_bound, np.float32)
        self._goal_bounds = np.asarray(task.goal_bound, np.float32)
        space = cast(gymnasium.spaces.Box, env.action_space)
        self._dtype = space.dtype
        self._low = space.low.astype(np.float64)
        self._range = space.high.astype(np.float64) - self._low
        self._is_unscaled = bool((space.low == -1).all() and (space.high == 1).all())
        self._n_steps = 0
        self._goal = np.zeros(0, np.float32)

    def reset(self, seed: int | None, **options: Any) -> tuple[Floats, Floats, dict[str, Any]]:
        """Starts an episode.

        Returns:
            The observation, shape `[n_observation]`, the goal, shape `[n_goal]`, and the environment's info.
        """
        observation, info = self._env.reset(seed=seed, **options)
        self._n_steps = 0
        # A copy: the environment may change its own array in place.
        goal = np.array(observation["desired_goal"], np.float32)
        _check_numbers("desired_goal", goal, self._goal_bounds)
        self._goal = goal
        return self._vector(observation), goal, info

    def step(self, action: Floats) -> tuple[Floats, SupportsFloat, dict[str, Any]]:
        """Executes an action in [-1, 1], shape `[n_action]`.

        Returns:
            The observation, shape `[n_observation]`, and the environment's reward and info.
        """
        observation, reward, terminated, _, info = self._env.step(self._own_action(action))
        self._n_steps += 1
        if not np.array_equal(np.asarray(observation["desired_goal"], np.float32), self._goal):
            raise InvalidEpisode(f"desired_goal changed at step {self._n_steps}: an episode has one goal")
        if terminated and self._n_steps < self._task.episode_steps:
            self._check_termination(observation)
        return self._vector(observation), reward, info

    def close(self) -> None:
        """Closes the environment."""
        self._env.close()

    def _own_action(self, action: Floats) -> NDArray[Any]:
        action = np.clip(action, -1, 1)
        if self._is_unscaled:
            return action.astype(self._dtype)
        return (self._low + (action.astype(np.float64) + 1) / 2 * self._range).astype(self._dtype)

    def _vector(self, observation: dict[str, Any]) -> Floats:
        parts = [observation["observation"]]
        if self._appends_goal:
            parts.append(observation["achieved_goal"])
        vector = np.concatenate(parts).astype(np.float32)
        _check_numbers("observation", vector, self._bounds)
        return vector

    def _check_termination(self, observation: dict[str, Any]) -> None:
        """Accepts an end because the goal is achieved, after which the environment is stepped on."""
        task = self._task
        apart = distance(task.norm, observation["achieved_goal"], observation["desired_goal"])
        if apart > task.tolerance * (1 + TOLERANCE_ERROR):
            raise InvalidEpisode(
                f"the environment terminated at step {self._n_steps} without its goal: "
                f"an episode always has {task.episode_steps} steps"
            )


def _check_numbers(name: str, numbers: Floats, bounds: Floats) -> None:
    if numbers.shape != bounds.shape:
        raise InvalidEpisode(f"{name} has shape {list(numbers.shape)}, expected {list(bounds.shape)}")
    # Written so that NaN fails the comparison.
    within = np.abs(numbers) <= bounds
    if not within.all():
        index = int(np.argmin(within))
        raise InvalidEpisode(f"{name}[{index}] is {numbers[index]:g}, beyond its bound {bounds[index]:g}")


def contact_bits(info: dict[str, Any]) -> int:
    """Returns the contacts in the infos of a step: bit 0 `arm_contact`, bit 1 `table_contact`."""
    return bool(info.get("arm_contact")) | bool(info.get("table_contact")) << 1
