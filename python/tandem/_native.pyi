"""The compiled part of the package: `python/src/lib.rs`."""

import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Floats = NDArray[np.float32]
_Bools = NDArray[np.bool_]
_Observations = tuple[_Floats, _Floats, _Floats]
_Infos = tuple[_Bools, _Bools, _Bools]

def task_description(name: str, n_arms: int) -> str: ...
def check_task(description: str) -> None: ...
def read_episode(path: str | os.PathLike[str]) -> dict[str, Any] | str: ...

class Simulation:
    n_action: int
    observation_bounds: _Floats
    goal_bounds: _Floats
    def __new__(
        cls, task: str, n_arms: int, *, substeps: int, grasped_start_prob: float, randomization: float
    ) -> Simulation: ...
    def reset(self, seed: int, number: int) -> tuple[dict[str, _Floats], dict[str, Any]]: ...
    def step(self, action: ArrayLike) -> tuple[dict[str, _Floats], float, bool, bool, dict[str, Any]]: ...
    def step_without_physics(
        self, action: ArrayLike
    ) -> tuple[dict[str, _Floats], float, bool, bool, dict[str, Any]]: ...
    def play(self, actions: _Floats) -> _Floats: ...
    def render(self, width: int, height: int) -> NDArray[np.uint8]: ...

class VectorSimulation:
    def __new__(
        cls,
        task: str,
        n_arms: int,
        num_envs: int,
        *,
        substeps: int,
        grasped_start_prob: float,
        randomization: float,
        max_episode_steps: int,
        autoreset: str,
        num_threads: int,
    ) -> VectorSimulation: ...
    def reset(self, seeds: list[int | None] | None, mask: list[bool]) -> tuple[_Observations, _Infos]: ...
    def step(self, actions: _Floats) -> tuple[_Observations, NDArray[np.float64], _Bools, _Infos]: ...
    def last(self) -> tuple[_Observations, _Infos]: ...
    def render(self, width: int, height: int) -> list[NDArray[np.uint8]]: ...

class Policy:
    task: str
    n_arms: int
    n_observation: int
    n_goal: int
    n_action: int
    n_heads: int
    has_critic: bool
    metadata: dict[str, str]
    digest: str
    def __new__(cls, path: str | os.PathLike[str]) -> Policy: ...
    @staticmethod
    def from_bytes(bytes: bytes) -> Policy: ...
    def to_bytes(self) -> bytes: ...
    def tensors(self) -> dict[str, _Floats]: ...
    def act(self, observations: _Floats, goals: _Floats) -> _Floats: ...
    def q(self, observations: _Floats, goals: _Floats, actions: _Floats) -> _Floats: ...

def compute_reward(achieved: _Floats, desired: _Floats) -> _Floats: ...
