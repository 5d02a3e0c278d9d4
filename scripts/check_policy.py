#!/usr/bin/env python3
"""Computes actions and values from a policy file as docs/policy-format.md says, and compares them.

Needs numpy and safetensors. Usage:

    cargo run --release -p tandem-policy --example policy_probe -- FILE > probe.json
    python3 scripts/check_policy.py FILE probe.json
"""

import hashlib
import json
import sys

import numpy as np
from safetensors import safe_open

TOLERANCE = 1e-5


def read(path):
    """The metadata and the tensors, float32, of a policy file."""
    with safe_open(path, framework="numpy") as file:
        return file.metadata(), {name: file.get_tensor(name) for name in file.keys()}


def network(tensors, prefix, n_layers, rows):
    """Passes rows [n, n_input] through a network: ReLU between layers, none after the last."""
    for layer in range(n_layers):
        weight, bias = (tensors[f"{prefix}.layers.{layer}.{part}"].astype(np.float64) for part in ("weight", "bias"))
        rows = rows @ weight.T + bias
        if layer < n_layers - 1:
            rows = np.maximum(rows, 0.0)
    return rows


def inputs(metadata, tensors, observations, goals):
    """Normalised observations and goals, side by side."""
    clip = float(metadata["normalizer_clip"])
    parts = []
    for name, raw in (("observation", observations), ("goal", goals)):
        mean, std = (tensors[f"normalizer.{name}.{part}"].astype(np.float64) for part in ("mean", "std"))
        parts.append(np.clip((raw - mean) / std, -clip, clip))
    return np.concatenate(parts, axis=1)


def digest(metadata, tensors):
    """SHA-256 over names and little-endian numbers: actor, critic, normalisers."""
    n_layers = int(metadata["n_hidden_layers"]) + 1
    names = [
        f"{prefix}.layers.{layer}.{part}"
        for prefix in ("actor", "critic.0")
        for layer in range(n_layers)
        for part in ("weight", "bias")
    ]
    names += [f"normalizer.{name}.{part}" for name in ("observation", "goal") for part in ("mean", "std")]
    assert sorted(names) == sorted(tensors), "the file's tensors are not the format's"
    sha = hashlib.sha256()
    for name in names:
        sha.update(name.encode())
        sha.update(tensors[name].astype("<f4").tobytes())
    return sha.hexdigest()


def main(policy_path, probe_path):
    metadata, tensors = read(policy_path)
    with open(probe_path, encoding="utf-8") as file:
        probe = json.load(file)
    observations, goals = np.array(probe["observations"]), np.array(probe["goals"])
    n_layers = int(metadata["n_hidden_layers"]) + 1

    rows = inputs(metadata, tensors, observations, goals)
    actions = np.tanh(network(tensors, "actor", n_layers, rows))
    q = network(tensors, "critic.0", n_layers, np.concatenate([rows, np.array(probe["actions"])], axis=1))
    action_error = np.abs(actions - np.array(probe["actions"])).max()
    q_error = (np.abs(q - np.array(probe["q"])) / np.maximum(1.0, np.abs(q))).max()
    digests = {digest(metadata, tensors), probe["digest"], metadata.get("digest", probe["digest"])}

    print(f"{len(rows)} rows: actions differ by {action_error:.1e}, values by {q_error:.1e} (of 1 or more)")
    if len(digests) != 1:
        sys.exit(f"digests differ: {sorted(digests)}")
    if not (action_error < TOLERANCE and q_error < TOLERANCE):
        sys.exit(f"differences of {TOLERANCE:.0e} or more")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
