"""The simulated environments with Gymnasium's interface."""

from __future__ import annotations

import copy
import dataclasses
import operator
from typing import Any, SupportsIndex, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from tandem import _native

Observation = dict[str, NDArray[np.float32]]
Action = NDArray[np.float32]

EPISODE_STEPS = 50
"""Control steps of an episode."""

DISTANCE_THRESHOLD_M = 0.05
"""The distance up to which a goal counts as achieved."""

TASKS = {
    "tandem/Push-v0": ("push", 1, "classic"),
    "tandem/PickAndPlace-v0": ("pick-and-place", 1, "classic"),
    "tandem/TwoArmPush-v0": ("push", 2, "classic"),
    "tandem/TwoArmPickAndPlace-v0": ("pick-and-place", 2, "classic"),
    "tandem/SharedPush-v0": ("push", 1, "shared"),
    "tandem/SharedPickAndPlace-v0": ("pick-and-place", 1, "shared"),
    "tandem/SharedTwoArmPush-v0": ("push", 2, "shared"),
    "tandem/SharedTwoArmPickAndPlace-v0": ("pick-and-place", 2, "shared"),
    "tandem/CarryBar-v0": ("carry-bar", 2, "slow"),
}
"""Task, number of arms and world of the simulator's environments."""
_FETCH_TASKS = {"tandem/TwoFetchPush-v0": "push", "tandem/TwoFetchPickAndPlace-v0": "pick-and-place"}

RENDER_FPS = {"classic": 25, "shared": 4, "slow": 4}
"""Control steps per second of simulated time in each world."""


class TandemEnv(gymnasium.Env[Observation, Action]):
    """One or two simulated arms that push cubes, or pick and place them, or two arms that carry a bar.

    An observation has 28 float32 numbers per arm, a goal the 3 coordinates of each cube in metres, and an action 3
    numbers per arm (`push`) or 4 (`pick-and-place`), each in [-1, 1]. Every arm's numbers are in its own frame. The
    reward is 0 if the distance between all achieved and desired positions, taken together, is at most 5 cm, and -1
    otherwise. `info["is_success"]` holds if each cube is within 5 cm of its goal; a bar must also be level and held by
    both hands, after each of the last five steps. `info["arm_contact"]` and
    `info["table_contact"]` report contacts between arms and with the table during the step.

    An episode never terminates. `gymnasium.make` truncates it after 50 steps.

    Environments can be pickled and copied. A copy continues the current episode with the same bits: unpickling plays
    the episode's actions again.

    `reset(seed=s)` starts episode 0 of seed `s`, and each `reset()` after it the next episode. The number of an
    episode can be chosen with `reset(options={"episode": k})`. Given seed and number, the episode has the same bits as
    in the Rust crates.

    Args:
        task: `"push"`, `"pick-and-place"` or `"carry-bar"`, whose cubes are the handles of one bar.
        n_arms: 1 or 2; 2 for `"carry-bar"`.
        world: `"shared"` (slow arms that share one area, control steps of 0.25 s), `"classic"` (fast arms whose areas
            lie next to each other, control steps of 0.04 s) or `"slow"` (the only world of `"carry-bar"`).
        substeps: Resolution of the physics, 20 or 10: physics steps per control step in the classic world, a quarter
            of their number in the others.
        grasped_start_prob: Probability that an episode of pick and place starts with the cubes grasped.
        randomization: Extent to which the world varies between episodes, in [0, 1], as the setting
            `world.randomization` of a run: size and mass of the cubes, friction, delay of the actions, errors of
            observed positions, with which achieved goals, rewards and success are computed, and in the shared world
            the gap of up to 2 cm below which two arms count as touching. 0 disables it, 1 uses the full ranges.
        render_mode: `"rgb_array"` or None.
        width: Width of pictures, pixels.
        height: Height of pictures, pixels.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(
        self,
        task: str = "push",
        n_arms: int = 2,
        *,
        world: str = "shared",
        substeps: int = 20,
        grasped_start_prob: float = 0.0,
        randomization: float = 0.0,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 400,
    ) -> None:
        check_rendering(render_mode, width, height)
        self._task, self._n_arms, self._world = task_name(task, world), checked_number("n_arms", n_arms), world
        self._simulation = _native.Simulation(
            self._task,
            self._n_arms,
            substeps=substeps,
            grasped_start_prob=grasped_start_prob,
            randomization=randomization,
        )
        self.metadata = {**type(self).metadata, "render_fps": RENDER_FPS[world]}
        self.render_mode = render_mode
        self._size = (width, height)
        self.observation_space, self.action_space = spaces_of(self._simulation)
        self._seed: int | None = None
        self._episode = 0

    @property
    def task(self) -> str:
        """Name of the task as in policy files, such as `shared-push`; with the same world, the constructor takes it."""
        return self._task

    @property
    def n_arms(self) -> int:
        """Number of arms."""
        return self._n_arms

    @property
    def world(self) -> str:
        """Name of the world: `shared`, `classic` or `slow`."""
        return self._world

    @property
    def distance_threshold(self) -> float:
        """Distance up to which a goal counts as achieved, metres."""
        return DISTANCE_THRESHOLD_M

    @property
    def dt(self) -> float:
        """Simulated time of a control step, seconds."""
        return 1 / RENDER_FPS[self._world]

    @property
    def tandem_task(self) -> dict[str, Any]:
        """Arguments of `tandem.serve` that describe the task, so that a server has the built-in one. Needs gRPC."""
        from tandem._task import Task

        task = Task.built_in(self._task, self._n_arms)
        of_spaces = ("n_observation", "n_goal", "n_action", "observation_bound")
        return {
            field.name: getattr(task, field.name) for field in dataclasses.fields(task) if field.name not in of_spaces
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Starts the sequence of episodes of this seed, in [0, 2**64). Without a seed the sequence continues;
                the first reset draws a seed from the operating system's entropy.
            options: `{"episode": k}` starts episode `k` of the sequence, in [0, 2**64).

        Returns:
            Observation and info.

        Raises:
            ValueError: The seed or an option is not an integer in its range, or the sequence has no next episode;
                nothing has changed.
        """
        if seed is not None:
            seed = checked_number("seed", seed)
        number = episode_option(options)
        if number is None:
            number = self._episode + 1 if seed is None and self._seed is not None else 0
        if number == 2**64:
            raise ValueError(f"episode 2**64 - 1 of seed {self._seed} has no next one: give a seed or an episode")
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**63)) if self._seed is None else self._seed
        self._seed, self._episode = seed, number
        return self._simulation.reset(seed, number)

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Executes `action`, shape `[n_action]`, for one control step.

        Raises:
            ValueError: The action has another shape or contains a number that is not finite; nothing has moved.
        """
        return self._simulation.step(action)

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> float | NDArray[np.float32]:
        """Returns the sparse rewards of goals of shape `[..., n_goal]`, shape `[...]`; `info` has no effect."""
        return compute_reward(achieved_goal, desired_goal)

    def compute_terminated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> bool:
        """Returns False: an episode never terminates."""
        return False

    def compute_truncated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> bool:
        """Returns False: `gymnasium.make` truncates episodes by their number of steps."""
        return False

    def render(self) -> NDArray[np.uint8] | None:
        """Draws the scene, shape `[height, width, 3]`, in render mode `rgb_array`."""
        return None if self.render_mode is None else self._simulation.render(*self._size)

    def __repr__(self) -> str:
        world = "" if self._world == "shared" else f", world={self._world!r}"
        return f"TandemEnv({self._task!r}, {self._n_arms}{world})"

    def __copy__(self) -> TandemEnv:
        # A shallow copy would share the simulation.
        return copy.deepcopy(self)


def task_name(task: str, world: str) -> str:
    """Returns the name that `task` in `world` has in files, such as `"shared-push"`.

    Such a name is accepted as `task` too, if its world is `world`.

    Raises:
        ValueError: The world or the task does not exist.
    """
    if world not in RENDER_FPS:
        raise ValueError(f"unknown world {world!r}: expected {' or '.join(RENDER_FPS)}")
    if world == "shared":
        task = task.removeprefix("shared-")
    if task not in ("push", "pick-and-place", "carry-bar"):
        raise ValueError(f"unknown task {task!r} in world {world!r}: expected push, pick-and-place or carry-bar")
    if (task == "carry-bar") != (world == "slow"):
        raise ValueError(f"no task {task!r} in world {world!r}: carry-bar is the only task of the slow world")
    return f"{world}-{task}" if world == "shared" else task


def env_id_of(task: str, n_arms: int) -> str | None:
    """Returns the name of the environment with the task that files name `task`; None if the simulator has none."""
    for env_id, (name, number, world) in TASKS.items():
        if (task_name(name, world), number) == (task, n_arms):
            return env_id
    return None


def compute_reward(achieved_goal: ArrayLike, desired_goal: ArrayLike) -> float | NDArray[np.float32]:
    """Returns the sparse reward of goals: 0 within 5 cm, -1 beyond.

    Args:
        achieved_goal: Achieved positions, shape `[..., n_goal]`, metres.
        desired_goal: Desired positions, of the same shape.

    Returns:
        A float for two goals of shape `[n_goal]`, otherwise an array of shape `[...]`.
    """
    achieved, desired = (np.asarray(goal, dtype=np.float32) for goal in (achieved_goal, desired_goal))
    if achieved.shape != desired.shape or achieved.ndim == 0:
        raise ValueError(f"goals have shapes {achieved.shape} and {desired.shape}, expected equal ones [..., n_goal]")
    shape = achieved.shape[:-1]
    n_goal = achieved.shape[-1]
    rewards = _native.compute_reward(achieved.reshape(-1, n_goal), desired.reshape(-1, n_goal))
    return rewards.reshape(shape) if shape else float(rewards[0])


def spaces_of(simulation: _native.Simulation) -> tuple[spaces.Space[Observation], spaces.Space[Action]]:
    """Returns the spaces of observations and actions.

    Numbers of a correct simulation are within the bounds. Desired goals have the bounds of achieved ones, so that an
    observation whose goal was replaced in hindsight lies in the space as well.
    """
    goal = simulation.goal_bounds
    bounds = {"observation": simulation.observation_bounds, "achieved_goal": goal, "desired_goal": goal}
    boxes: dict[str, spaces.Space[Any]] = {
        name: spaces.Box(-high, high, dtype=np.float32) for name, high in bounds.items()
    }
    action = spaces.Box(-1.0, 1.0, (simulation.n_action,), dtype=np.float32)
    return cast(spaces.Space[Observation], spaces.Dict(boxes)), cast(spaces.Space[Action], action)


def episode_option(options: dict[str, Any] | None) -> int | None:
    """Returns the number of the episode that the options of a reset ask for."""
    options = dict(options or {})
    number = options.pop("episode", None)
    if options:
        raise ValueError(f"unknown options {sorted(options)}: expected episode")
    return None if number is None else checked_number("episode", number)


def checked_number(name: str, number: SupportsIndex) -> int:
    """Returns a seed, the number of an episode or of arms.

    Raises:
        ValueError: It is not an integer in [0, 2**64).
    """
    try:
        checked = operator.index(number)
    except TypeError:
        raise ValueError(f"{name} is {number!r}, expected an integer") from None
    if not 0 <= checked < 2**64:
        raise ValueError(f"{name} is {checked}, expected 0 to 2**64 - 1")
    return checked


def check_rendering(render_mode: str | None, width: int, height: int) -> None:
    """Raises a `ValueError` for a mode or a size of pictures that does not exist."""
    if render_mode not in (None, "rgb_array"):
        window = 'gymnasium.make shows "human" in a window (needs pygame)'
        video = 'gymnasium.wrappers.RecordVideo records "rgb_array" (needs moviepy)'
        raise ValueError(f'unknown render mode {render_mode!r}: expected "rgb_array" or None; {window}, {video}')
    if not (1 <= width <= 4096 and 1 <= height <= 4096):
        raise ValueError(f"pictures of {width} x {height} pixels: expected 1 to 4096 each")


def register_envs() -> None:
    """Registers the environments with Gymnasium, once."""
    for env_id, (task, n_arms, world) in TASKS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="tandem.envs:TandemEnv",
                vector_entry_point="tandem.vector:TandemVectorEnv",
                max_episode_steps=EPISODE_STEPS,
                kwargs={"task": task, "n_arms": n_arms, "world": world},
            )
    for env_id, task in _FETCH_TASKS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="tandem.two_fetch:TwoFetchEnv",
                max_episode_steps=EPISODE_STEPS,
                kwargs={"task": task},
            )
