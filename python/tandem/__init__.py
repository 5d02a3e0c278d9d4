"""Environments, policies and services of Tandem: two robot arms, and advice from a policy for one arm.

Importing the package registers four environments with Gymnasium: `tandem/Push-v0`, `tandem/PickAndPlace-v0`,
`tandem/TwoArmPush-v0` and `tandem/TwoArmPickAndPlace-v0`.
"""

from tandem.envs import TandemEnv, compute_reward, register_envs
from tandem.policy import Policy, load_policy
from tandem.vector import TandemVectorEnv

__all__ = ["Policy", "TandemEnv", "TandemVectorEnv", "compute_reward", "load_policy"]

register_envs()
