#!/usr/bin/env python3
"""Exports policies as other libraries build them with PyTorch, for onnx/tests/pytorch.rs.

    python scripts/pytorch_onnx.py onnx/tests/pytorch

Needs torch, onnx and onnxscript. Writes models with small arbitrary networks for one pushing arm, and cases.json with
states and PyTorch's outputs.
"""

import json
import sys
import warnings
from pathlib import Path

import onnx
import torch
from torch import nn

N_OBSERVATION, N_GOAL, N_ACTION, N_ROWS = 28, 3, 3, 8


class MultiInputActor(nn.Module):
    """As Stable-Baselines3's TD3 with MultiInputPolicy for HER: the entries in the order of their names."""

    def __init__(self):
        super().__init__()
        self.flatten = nn.Flatten()
        self.mu = nn.Sequential(
            nn.Linear(N_GOAL + N_GOAL + N_OBSERVATION, 24), nn.ReLU(), nn.Linear(24, 16), nn.ReLU(),
            nn.Linear(16, N_ACTION), nn.Tanh(),
        )

    def forward(self, achieved_goal, desired_goal, observation):
        parts = [self.flatten(part) for part in (achieved_goal, desired_goal, observation)]
        return self.mu(torch.cat(parts, dim=1))


class MultiInputCritic(nn.Module):
    """As Stable-Baselines3's ContinuousCritic, its first network."""

    def __init__(self):
        super().__init__()
        n_input = N_GOAL + N_GOAL + N_OBSERVATION + N_ACTION
        self.qf0 = nn.Sequential(nn.Linear(n_input, 24), nn.ReLU(), nn.Linear(24, 16), nn.ReLU(), nn.Linear(16, 1))

    def forward(self, achieved_goal, desired_goal, observation, action):
        return self.qf0(torch.cat([achieved_goal, desired_goal, observation, action], dim=1))


class NormalizedTanhActor(nn.Module):
    """As PPO's actor behind VecNormalize: one input, tanh between the layers, actions clipped to their space."""

    def __init__(self):
        super().__init__()
        self.register_buffer("mean", torch.randn(N_OBSERVATION + N_GOAL) * 0.1)
        self.register_buffer("std", torch.rand(N_OBSERVATION + N_GOAL) + 0.05)
        self.policy = nn.Sequential(nn.Linear(N_OBSERVATION + N_GOAL, 16), nn.Tanh(), nn.Linear(16, 16), nn.Tanh())
        self.action = nn.Linear(16, N_ACTION)

    def forward(self, obs):
        rows = torch.clamp((obs - self.mean) / self.std, -10.0, 10.0)
        return torch.clamp(self.action(self.policy(rows)), -1.0, 1.0)


class ScaledActor(nn.Module):
    """As CleanRL's DDPG actor: layers without nn.Sequential, and the action scaled to its space."""

    def __init__(self):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(N_OBSERVATION + N_GOAL, 16), nn.Linear(16, 16)
        self.fc_mu = nn.Linear(16, N_ACTION)
        self.register_buffer("action_scale", torch.ones(1, N_ACTION))
        self.register_buffer("action_bias", torch.zeros(1, N_ACTION))

    def forward(self, observation, goal):
        rows = torch.relu(self.fc1(torch.cat([observation, goal], 1)))
        rows = torch.relu(self.fc2(rows))
        return torch.tanh(self.fc_mu(rows)) * self.action_scale + self.action_bias


def export(module, path, inputs, output, dynamo):
    names = list(inputs)
    arguments = tuple(inputs.values())
    options = {"input_names": names, "output_names": [output]}
    if dynamo:
        batch = torch.export.Dim("batch")
        options |= {"dynamo": True, "external_data": False, "dynamic_shapes": [{0: batch}] * len(names)}
    else:
        options |= {"dynamo": False, "opset_version": 13, "dynamic_axes": {n: {0: "batch"} for n in names + [output]}}
    torch.onnx.export(module.eval(), arguments, str(path), verbose=False, **options)
    strip(path)


def strip(path):
    """Removes the exporter's notes on the source, which name files of this machine."""
    model = onnx.load(path)
    for part in [model.graph, *model.graph.node, *model.graph.input, *model.graph.output, *model.graph.value_info]:
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    onnx.save(model, path)


def main(directory):
    warnings.filterwarnings("ignore")
    torch.manual_seed(7)
    observation = torch.rand(N_ROWS, N_OBSERVATION) - 0.5
    goal, action = torch.rand(N_ROWS, N_GOAL) - 0.5, 2.0 * torch.rand(N_ROWS, N_ACTION) - 1.0
    # The object's position, which is the achieved goal.
    states = {"achieved_goal": observation[:, 3:6].clone(), "desired_goal": goal, "observation": observation}
    joined = {"obs": torch.cat([observation, goal], dim=1)}
    models = [
        ("sb3-actor", MultiInputActor(), states, "action"),
        ("sb3-critic", MultiInputCritic(), states | {"action": action}, "value"),
        ("normalized-tanh-actor", NormalizedTanhActor(), joined, "action"),
        ("scaled-actor", ScaledActor(), {"observation": observation, "goal": goal}, "action"),
    ]
    cases = {"observations": observation.tolist(), "goals": goal.tolist(), "actions": action.tolist(), "outputs": {}}
    for name, module, inputs, output in models:
        for exporter, dynamo in (("torchscript", False), ("dynamo", True)):
            export(module, Path(directory) / f"{name}.{exporter}.onnx", inputs, output, dynamo)
        cases["outputs"][name] = module(*inputs.values()).tolist()
    (Path(directory) / "cases.json").write_text(json.dumps(cases) + "\n", encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
