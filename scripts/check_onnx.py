#!/usr/bin/env python3
"""Runs exported models with ONNX Runtime and compares them with Tandem's actions and values.

    tandem policy export FILE --onnx actor.onnx --critic-onnx critic.onnx
    cargo run --release -p tandem-policy --example policy_probe -- FILE 1000 > probe.json
    tandem eval --policy FILE --episodes 200 --record-dir logs
    python3 scripts/check_onnx.py FILE actor.onnx critic.onnx probe.json logs

The logs have simulated observations and the policy's actions. Hidden units reach 200 or more, so an action in which
large terms cancel has rounding errors of 1e-5 or more in float32, whatever the order of summation. The root mean square
of the differences must therefore be below 1e-6, between ONNX Runtime and Tandem and between each of them and double
precision, and at most one observation in 1,000 may have an action that differs by 1e-5 or more in any component, none
by 1e-4. In the arbitrary states of the probe the networks extrapolate; there, actions and values must agree to 1e-4.
Values are compared relative to values above 1. Needs the packages of scripts/requirements.txt. Ends with code 1 and one
line on standard error if the numbers do not agree.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import check_policy

SIMULATED_RMS = 1e-6
SIMULATED_TOLERANCE = 1e-5
SIMULATED_SHARE_APART = 0.001
LARGEST_DIFFERENCE = 1e-4


def session(path):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def probe_rows(path):
    """Observations, goals, actions and values of a probe."""
    with open(path, encoding="utf-8") as file:
        probe = json.load(file)
    return [np.array(probe[key], dtype=np.float32) for key in ("observations", "goals", "actions", "q")]


def log_rows(directory):
    """Observations, goals and actions of recorded episodes."""
    rows = []
    for path in sorted(Path(directory).glob("*.mcap")):
        with open(path, "rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            for _, _, _, message in reader.iter_decoded_messages(topics=["/transition"]):
                rows.append((message.observation, message.goal, message.action))
    if not rows:
        sys.exit(f"no transitions in {directory}")
    return [np.array(column, dtype=np.float32) for column in zip(*rows)]


def compare(what, got, expected, tolerance):
    if got.shape != expected.shape:
        sys.exit(f"{what}: shape {got.shape}, expected {expected.shape}")
    difference = float((np.abs(got - expected) / np.maximum(1.0, np.abs(expected))).max())
    print(f"{what}, {len(expected)} rows: differ by {difference:.1e}")
    if not difference < tolerance:
        sys.exit(f"{what}: differences of {tolerance:.0e} or more")


def compare_simulated(what, got, expected):
    difference = np.abs(got - expected)
    rms, largest = float(np.sqrt((difference**2).mean())), float(difference.max())
    n_rows, n_apart = len(expected), int((difference.max(axis=1) >= SIMULATED_TOLERANCE).sum())
    apart = f"{n_apart} of {n_rows} observations differ by {SIMULATED_TOLERANCE:.0e} or more"
    print(f"{what}: root mean square {rms:.1e}, largest difference {largest:.1e}; {apart}")
    if not rms < SIMULATED_RMS:
        sys.exit(f"{what}: the root mean square is {SIMULATED_RMS:.0e} or more")
    if n_apart > SIMULATED_SHARE_APART * n_rows:
        sys.exit(f"{what}: {apart}")
    if not largest < LARGEST_DIFFERENCE:
        sys.exit(f"{what}: differences of {LARGEST_DIFFERENCE:.0e} or more")


def exact_actions(policy_path, observations, goals):
    """Actions in double precision, computed from the policy file."""
    metadata, tensors = check_policy.read(policy_path)
    rows = check_policy.inputs(metadata, tensors, observations, goals)
    return np.tanh(check_policy.network(tensors, "actor", int(metadata["n_hidden_layers"]) + 1, rows))


def main(policy_path, actor_path, critic_path, probe_path, log_directory):
    actor, critic = session(actor_path), session(critic_path)
    metadata = actor.get_modelmeta().custom_metadata_map
    observation_parts = json.loads(metadata["observation"])
    n_observation = actor.get_inputs()[0].shape[1]
    if observation_parts[-1]["end"] != n_observation:
        sys.exit("the metadata describes other observations than the model takes")

    observations, goals, actions, values = probe_rows(probe_path)
    states = {"observation": observations, "goal": goals}
    compare("actions in arbitrary states", actor.run(["action"], states)[0], actions, LARGEST_DIFFERENCE)
    got = critic.run(["value"], states | {"action": actions})[0]
    compare("values of these actions", got, values, LARGEST_DIFFERENCE)
    one = {name: rows[:1] for name, rows in states.items()}
    compare("actions of a batch of one", actor.run(["action"], one)[0], actions[:1], LARGEST_DIFFERENCE)
    observations, goals, actions = log_rows(log_directory)
    states = {"observation": observations, "goal": goals}
    got, exact = actor.run(["action"], states)[0], exact_actions(policy_path, observations, goals)
    compare_simulated("ONNX Runtime and Tandem", got, actions)
    compare_simulated("ONNX Runtime and double precision", got, exact)
    compare_simulated("Tandem and double precision", actions, exact)


if __name__ == "__main__":
    if len(sys.argv) != 6:
        sys.exit(__doc__)
    main(*sys.argv[1:])
