"""An environment of one's own with the vectors that a server of it has."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike

from tandem._describe import TaskOptions, appends_goal, describe, environment_errors
from tandem._gym import GymEnvironment, first_outside
from tandem._task import Floats, Task
from tandem.panda import corrected
from tandem.policy import Policy

Observation = dict[str, Floats]


class ServedEnv(gymnasium.Wrapper[Observation, Floats, Any, Any], RecordConstructorArgs):
    """An environment with the observations and actions that `tandem.serve` gives workers, for policies trained on it.

    A server and this wrapper execute the same code:

    - `observation` is the environment's, followed by the achieved goal if the observation does not contain it.
      `achieved_goal` and `desired_goal` are the environment's. All numbers are float32.
    - Actions `a` in [-1, 1] are rescaled to `low + (a + 1) / 2 * (high - low)` of the environment's action space.
    - An episode has `task.episode_steps` steps: it is truncated after the last one, and an environment that ends it
      earlier because its goal is achieved is stepped on.
    - `info["is_success"]` holds if the last steps satisfy the task, as `tandem eval` counts it. The reward and all
      other infos are the environment's.

    The policy's file describes the task as its server found it. Without a policy, the constructor plays eight episodes
    of ten random steps to find the description, as a server does at its start.

    Args:
        env: The environment.
        policy: A policy that was trained on a server of this environment.
        options: Without a policy, the arguments of `tandem.serve` from `name` to `bound`.

    Attributes:
        task: The description of the task, `tandem.Task`.

    Raises:
        ServiceError: The environment cannot be served, or is not that of the policy's task.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], policy: Policy | None = None, **options: Any) -> None:
        names = () if policy is not None else (field.name for field in dataclasses.fields(TaskOptions))
        unknown = set(options).difference(names)
        if unknown:
            whose = "ServedEnv" if policy is None else "ServedEnv with a policy, whose file describes the task,"
            raise TypeError(f"{whose} does not take {', '.join(sorted(unknown))}")
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, policy=policy, **options)
        gymnasium.Wrapper.__init__(self, corrected(env))
        with environment_errors():
            if policy is None:
                task, appends = describe(self.env, TaskOptions.combined(self.env, options))
            else:
                task = Task.of_policy(policy)
                appends = appends_goal(self.env, task)
        self.task = task
        self._served = GymEnvironment(self.env, task, appends)
        bounds = np.asarray(task.observation_bound, np.float32)
        boxes: dict[str, spaces.Space[Any]] = {
            "observation": _box(bounds),
            "achieved_goal": _box(bounds[list(task.achieved_goal)]),
            "desired_goal": _box(np.asarray(task.goal_bound, np.float32)),
        }
        self.observation_space = cast(spaces.Space[Observation], spaces.Dict(boxes))
        self.action_space = spaces.Box(-1.0, 1.0, (task.n_action,), np.float32)
        self._goal: Floats | None = None
        # Playing has seeded the environment.
        self._needs_seed = policy is None
        self._n_steps = 0
        self._n_succeeding = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: The seed of the environment's `reset`; `tandem.episode_seed` gives those of a run.
            options: The options of the environment's `reset`.

        Raises:
            ServiceError: The environment breaks a rule of episodes, such as a bound.
        """
        if seed is None and self._needs_seed:
            seed = int(np.random.default_rng().integers(2**32))
        self._goal = None
        given = {} if options is None else {"options": options}
        observation, goal, info = self._served.reset(seed, **given)
        self._needs_seed = False
        self._goal, self._n_steps, self._n_succeeding = goal, 0, 0
        return self._observation(observation, goal), info

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Executes an action in [-1, 1], shape `[n_action]`.

        Raises:
            ValueError: The action has another shape, or a number outside [-1, 1]; nothing has moved.
            ServiceError: The environment breaks a rule of episodes, such as a bound.
        """
        if self._goal is None:
            raise gymnasium.error.ResetNeeded("an episode starts with reset()")
        observation, reward, info = self._served.step(self._checked(action))
        self._n_steps += 1
        succeeds = self.task.is_success(observation, self._goal)
        self._n_succeeding = self._n_succeeding + 1 if succeeds else 0
        info = {**info, "is_success": self._n_succeeding >= self.task.manipulation.success_steps}
        is_last = self._n_steps >= self.task.episode_steps
        return self._observation(observation, self._goal), float(reward), False, is_last, info

    def _checked(self, action: ArrayLike) -> Floats:
        numbers = np.asarray(action, np.float32)
        if numbers.shape != (self.task.n_action,):
            raise ValueError(f"the action has shape {list(numbers.shape)}, expected [{self.task.n_action}]")
        index = first_outside(numbers)
        if index is not None:
            raise ValueError(f"action[{index}] is {numbers[index]:g}, expected a number in [-1, 1]")
        return numbers

    def _observation(self, observation: Floats, goal: Floats) -> Observation:
        achieved = observation[list(self.task.achieved_goal)]
        return {"observation": observation, "achieved_goal": achieved, "desired_goal": goal.copy()}


def _box(bounds: Floats) -> spaces.Box:
    return spaces.Box(-bounds, bounds, dtype=np.float32)
