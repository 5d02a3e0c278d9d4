"""A small Gymnasium environment with goals, for tests of servers."""

import threading
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

STEPS = 12


class PointEnv(gymnasium.Env[dict[str, NDArray[Any]], NDArray[Any]]):
    """A point in a plane. Observations hold noise, the position in reverse order, and a constant."""

    def __init__(
        self,
        *,
        threshold: float = 0.25,
        contained: bool = True,
        maximum: bool = False,
        dense: bool = False,
        fails_at: int | None = None,
        hangs_at: int | None = None,
        terminates_at: int | None = None,
        contacts: bool = False,
        exits_at: int | None = None,
        moves_goal_at: int | None = None,
        nan_at: int | None = None,
        tandem_task: dict[str, Any] | None = None,
    ) -> None:
        unbounded = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.n_own = 4 if contained else 2
        bound = np.array([9.0] + [np.inf] * (self.n_own - 1))
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-bound, bound, dtype=np.float64),
                "achieved_goal": unbounded,
                "desired_goal": unbounded,
            }
        )
        self.action_space = spaces.Box(np.array([-2.0, 0.0]), np.array([2.0, 1.0]), dtype=np.float64)
        self.distance_threshold = threshold
        self._contained, self._maximum, self._dense = contained, maximum, dense
        self._fails_at, self._terminates_at = fails_at, terminates_at
        self._hangs_at = hangs_at
        self._contacts = contacts
        self._exits_at, self._moves_goal_at, self._nan_at = exits_at, moves_goal_at, nan_at
        self.tandem_task = tandem_task

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.actions: list[NDArray[Any]] = []
        self._position = self.np_random.normal(size=2)
        self._goal = self.np_random.normal(size=2)
        return self._observation(), {}

    def step(self, action: NDArray[Any]) -> Any:
        self.actions.append(action)
        if len(self.actions) == self._fails_at:
            raise RuntimeError("the motor is on fire")
        if len(self.actions) == self._hangs_at:
            threading.Event().wait()
        if len(self.actions) == self._exits_at:
            raise SystemExit("the motor is gone")
        if len(self.actions) == self._moves_goal_at:
            self._goal = self._goal + 1
        self._position = self._position + action / 10
        if len(self.actions) == self._nan_at:
            self._position[0] = np.nan
        terminated = len(self.actions) == self._terminates_at
        reward = self.compute_reward(self._position, self._goal, {})
        info = {"arm_contact": len(self.actions) % 2 == 0, "table_contact": True} if self._contacts else {}
        return self._observation(), reward, terminated, False, info

    def compute_reward(self, achieved: NDArray[Any], desired: NDArray[Any], info: Any) -> float:
        difference = np.abs(achieved - desired)
        distance = float(difference.max() if self._maximum else np.linalg.norm(difference))
        return -distance if self._dense else -float(distance > self.distance_threshold)

    def _observation(self) -> dict[str, NDArray[Any]]:
        noise = self.np_random.uniform(-9, 9)
        parts = [noise, *self._position[::-1], 7.0] if self._contained else [noise, 7.0]
        return {
            "observation": np.array(parts),
            "achieved_goal": self._position.copy(),
            "desired_goal": self._goal.copy(),
        }


def point_env(**kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Returns the environment without the spec that `gymnasium.make` would add."""
    return PointEnv(**kwargs)


gymnasium.register("Tandem/Point-v0", PointEnv, max_episode_steps=STEPS)
