"""Panda-gym's environments with resets that reproduce and spaces that contain their observations."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

_OUT_OF_REACH_M = 10.0


class CorrectedPanda(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment of panda-gym with two corrections. `tandem.serve` applies them to every environment of panda-gym.

    - **Resets.** Panda-gym moves robot and objects to their starts, but PyBullet keeps the contact points of the
      episode before, which changes the first physics steps (panda-gym's issue 94). Before each reset this wrapper lifts
      all objects out of reach, straightens the robot and makes one physics step, in which nothing touches and PyBullet
      drops its contact points. Episodes of Reach, Push, PickAndPlace and Slide then have the bits they have in a new
      environment. Those of Stack may still differ.
    - **Bounds.** Panda-gym's space bounds every number by 10, but objects that are struck turn faster. Here
      observations have no bound.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        space: Any = env.observation_space
        unbounded: dict[str, spaces.Space[Any]] = {
            name: spaces.Box(-np.inf, np.inf, box.shape, box.dtype) for name, box in space.items()
        }
        self.observation_space = spaces.Dict(unbounded)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode."""
        env: Any = self.env.unwrapped
        client = env.sim.physics_client
        for number, body in enumerate(env.sim._bodies_idx.values()):
            if client.getNumJoints(body) == 0 and client.getDynamicsInfo(body, -1)[0] > 0:
                client.resetBasePositionAndOrientation(body, (0, 0, _OUT_OF_REACH_M * (number + 1)), (0, 0, 0, 1))
        env.robot.reset()
        client.stepSimulation()
        return super().reset(seed=seed, options=options)


def corrected(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """Returns `env`, wrapped if it is one of panda-gym's."""
    core: Any = sys.modules.get("panda_gym.envs.core")
    if core is None or not isinstance(env.unwrapped, core.RobotTaskEnv):
        return env
    return CorrectedPanda(env)
