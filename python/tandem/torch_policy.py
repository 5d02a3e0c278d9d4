"""Policies as PyTorch modules. Importing this module needs PyTorch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from tandem.policy import Policy

_CLIP = 5.0


class _Normalizer(nn.Module):
    """Subtracts a mean, divides by a standard deviation and clips to [-5, 5]."""

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Tensor, std: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)

    def forward(self, x: Tensor) -> Tensor:
        return torch.clamp((x - self.mean) / self.std, -_CLIP, _CLIP)


class TorchPolicy(nn.Module):
    """A policy as a PyTorch module, float32, ready for inference or further training.

    `forward(observation, goal)` returns actions, shape `[..., n_action]`; `q(observation, goal, action)` returns
    values, shape `[..., n_heads]`, or raises a `ValueError` if the policy has no critic.
    """

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        tensors = {name: torch.from_numpy(array) for name, array in policy.tensors().items()}
        self.actor = nn.Sequential(*_layers(tensors, "actor"), nn.Tanh())
        self.critic = nn.Sequential(*_layers(tensors, "critic.0"))
        self.normalize_observation = _normalizer(tensors, "observation")
        self.normalize_goal = _normalizer(tensors, "goal")
        self._has_critic = policy.has_critic

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Returns actions in [-1, 1]."""
        action: Tensor = self.actor(self._inputs(observation, goal))
        return action

    def q(self, observation: Tensor, goal: Tensor, action: Tensor) -> Tensor:
        """Returns the values of actions."""
        if not self._has_critic:
            raise ValueError("the policy has no critic, and so no values")
        inputs = torch.cat([self._inputs(observation, goal), action], dim=-1)
        values: Tensor = self.critic(inputs)
        return values

    def _inputs(self, observation: Tensor, goal: Tensor) -> Tensor:
        return torch.cat([self.normalize_observation(observation), self.normalize_goal(goal)], dim=-1)


def _normalizer(tensors: dict[str, Tensor], name: str) -> _Normalizer:
    return _Normalizer(tensors[f"normalizer.{name}.mean"], tensors[f"normalizer.{name}.std"])


def _layers(tensors: dict[str, Tensor], network: str) -> list[nn.Module]:
    """Returns the linear layers of a network with ReLU between them."""
    n_layers = sum(name.startswith(f"{network}.") and name.endswith(".weight") for name in tensors)
    layers: list[nn.Module] = []
    for idx in range(n_layers):
        weight, bias = (tensors[f"{network}.layers.{idx}.{part}"] for part in ("weight", "bias"))
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": weight, "bias": bias})
        layers += [linear] if idx == 0 else [nn.ReLU(), linear]
    return layers
