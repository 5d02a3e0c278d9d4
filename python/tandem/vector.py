"""Many environments that are stepped in parallel, with Gymnasium's vector interface."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from tandem import _native
from tandem.envs import (
    EPISODE_STEPS,
    RENDER_FPS,
    Observation,
    check_rendering,
    checked_number,
    compute_reward,
    spaces_of,
    task_name,
)

_AUTORESET = {
    AutoresetMode.NEXT_STEP: "next_step",
    AutoresetMode.SAME_STEP: "same_step",
    AutoresetMode.DISABLED: "disabled",
}


class TandemVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """Environments of one task, stepped by a pool of threads without the interpreter lock.

    `gymnasium.make_vec("tandem/TwoArmPush-v0", num_envs=16)` creates one. Environment `i` after `reset(seed=s)` plays
    the episodes of the single environment after `reset(seed=s + i)`, bit for bit, with any number of threads.

    Args:
        num_envs: Number of environments.
        task: As for `TandemEnv`.
        n_arms: As for `TandemEnv`.
        world: As for `TandemEnv`.
        max_episode_steps: Steps after which an episode is truncated.
        autoreset_mode: When an environment whose episode is over starts the next one; Gymnasium's modes.
        num_threads: Number of threads; by default one per processor, at most one per environment.
        substeps: As for `TandemEnv`.
        grasped_start_prob: As for `TandemEnv`.
        randomization: As for `TandemEnv`.
        render_mode: `"rgb_array"` or None.
        width: Width of pictures, pixels.
        height: Height of pictures, pixels.
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": 25,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int,
        task: str = "push",
        n_arms: int = 2,
        *,
        world: str = "shared",
        max_episode_steps: int = EPISODE_STEPS,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        num_threads: int | None = None,
        substeps: int = 20,
        grasped_start_prob: float = 0.0,
        randomization: float = 0.0,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 400,
    ) -> None:
        threads = (os.cpu_count() or 1) if num_threads is None else num_threads
        counts = {"num_envs": num_envs, "max_episode_steps": max_episode_steps, "num_threads": threads}
        for name, count in counts.items():
            if not 1 <= count < 2**32:
                raise ValueError(f"{name} is {count}, expected 1 to 2**32 - 1")
        check_rendering(render_mode, width, height)
        mode = AutoresetMode(autoreset_mode)
        task, n_arms = task_name(task, world), checked_number("n_arms", n_arms)
        self.metadata = {**type(self).metadata, "autoreset_mode": mode, "render_fps": RENDER_FPS[world]}
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._size = (width, height)
        self._mode = mode
        world_settings: dict[str, Any] = {
            "substeps": substeps,
            "grasped_start_prob": grasped_start_prob,
            "randomization": randomization,
        }
        self._simulation = _native.VectorSimulation(
            task,
            n_arms,
            num_envs,
            **world_settings,
            max_episode_steps=max_episode_steps,
            autoreset=_AUTORESET[mode],
            num_threads=threads,
        )
        single = _native.Simulation(task, n_arms, **world_settings)
        self.single_observation_space, self.single_action_space = spaces_of(single)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._is_seeded = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode in every environment.

        Args:
            seed: A number `s` gives environment `i` seed `s + i`; a sequence gives each its own. All of them are in
                [0, 2**64). Without a seed, or where it is None, an environment starts the next episode of its seed.
            options: `{"reset_mask": mask}`, shape `[num_envs]`, resets only the environments where it is true.

        Returns:
            Observations, each of shape `[num_envs, ...]`, and infos.

        Raises:
            ValueError: A seed is not an integer in its range, or seeds or options have the wrong length; nothing has
                changed.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, np.bool_)), dtype=np.bool_)
        if options:
            raise ValueError(f"unknown options {sorted(options)}: expected reset_mask")
        if mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask has shape {mask.shape}, expected ({self.num_envs},)")
        seeds: list[int | None]
        first = None
        if seed is None:
            seeds = [None] * self.num_envs
        elif np.iterable(seed):  # Arrays without dimensions are not.
            seeds = list(seed)
        else:
            first = checked_number("seed", seed)
            seeds = [first + idx for idx in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seeds has length {len(seeds)}, expected {self.num_envs}")
        for idx, one in enumerate(seeds):
            seeds[idx] = None if one is None else checked_number(f"the seed of environment {idx}", one)
        super().reset(seed=first)
        if not self._is_seeded and None in seeds:
            drawn = self.np_random.integers(2**63, size=len(seeds)).tolist()
            seeds = [new if one is None else one for one, new in zip(seeds, drawn, strict=True)]
        observations, infos = self._simulation.reset(seeds, mask.tolist())
        self._is_seeded = True
        return _observation(observations), _info(infos)

    def step(
        self, actions: ArrayLike
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Executes one action per environment, shape `[num_envs, n_action]`.

        In mode `SAME_STEP` the last observations and infos of episodes that ended are in `final_obs` and `final_info`.

        Raises:
            ValueError: The actions have another shape or contain a number that is not finite, or an environment has no
                episode; no environment has moved.
        """
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {actions.shape}, expected {self.action_space.shape}")
        step = self._simulation.step(actions)
        observations, rewards, truncations, infos = step
        info = _info(infos)
        if self._mode is AutoresetMode.SAME_STEP and truncations.any():
            self._add_final(info, truncations)
        terminations = np.zeros(self.num_envs, np.bool_)
        return _observation(observations), rewards, terminations, truncations, info

    def compute_reward(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> float | NDArray[np.float32]:
        """Returns the sparse rewards of goals of shape `[..., n_goal]`, shape `[...]`; `info` has no effect."""
        return compute_reward(achieved_goal, desired_goal)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Draws every scene, shape `[height, width, 3]` each, in render mode `rgb_array`."""
        return None if self.render_mode is None else tuple(self._simulation.render(*self._size))

    def __copy__(self) -> TandemVectorEnv:
        # A shallow copy would share the simulations.
        return copy.deepcopy(self)

    def _add_final(self, info: dict[str, Any], is_over: NDArray[np.bool_]) -> None:
        """Adds what `SyncVectorEnv` reports about episodes that ended, in its form."""
        lasts, infos = self._simulation.last()
        final_obs = np.full(self.num_envs, None, dtype=object)
        final_info: dict[str, Any] = {}
        for row, idx in enumerate(np.flatnonzero(is_over)):
            final_obs[idx] = {name: rows[row] for name, rows in _observation(lasts).items()}
        for name, values in zip(_INFO_NAMES, infos, strict=True):
            final_info[name] = np.zeros(self.num_envs, np.bool_)
            final_info[name][is_over] = values
            final_info[f"_{name}"] = is_over.copy()
        info.update(
            final_obs=final_obs, _final_obs=is_over.copy(), final_info=final_info, _final_info=is_over.copy()
        )


_INFO_NAMES = ("is_success", "arm_contact", "table_contact")


def _observation(arrays: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]) -> Observation:
    observation, achieved, desired = arrays
    return {"observation": observation, "achieved_goal": achieved, "desired_goal": desired}


def _info(arrays: tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]) -> dict[str, Any]:
    """Returns infos with the masks that Gymnasium's vector interface asks for: every environment has each entry."""
    info: dict[str, Any] = {}
    for name, values in zip(_INFO_NAMES, arrays, strict=True):
        info[name], info[f"_{name}"] = values, np.ones(len(values), np.bool_)
    return info
