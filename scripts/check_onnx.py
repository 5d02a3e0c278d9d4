#!/usr/bin/env python3
"""Runs exported models with ONNX Runtime and compares them with Tandem's actions and values.

    tandem policy export FILE --onnx actor.onnx --critic-onnx critic.onnx
    cargo run --release -p tandem-policy --example policy_probe -- FILE 1000 > probe.json
    tandem eval --policy FILE --episodes 20 --record-dir logs
    python3 scripts/check_onnx.py actor.onnx critic.onnx probe.json logs

The logs have simulated observations and the policy's actions, which must agree to 1e-5. The probe has actions and
values of arbitrary states. There the networks extrapolate and their numbers before the tanh reach 100, so both programs differ
from exact arithmetic by up to 3e-5, the rounding of float32; these must agree to 1e-4. Values are compared relative to
values above 1. Needs the packages of scripts/requirements.txt. Ends with code 1 and one line on standard error if the
numbers do not agree.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

SIMULATED_TOLERANCE = 1e-5
ARBITRARY_TOLERANCE = 1e-4


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


def main(actor_path, critic_path, probe_path, log_directory):
    actor, critic = session(actor_path), session(critic_path)
    metadata = actor.get_modelmeta().custom_metadata_map
    observation_parts = json.loads(metadata["observation"])
    n_observation = actor.get_inputs()[0].shape[1]
    if observation_parts[-1]["end"] != n_observation:
        sys.exit("the metadata describes other observations than the model takes")

    observations, goals, actions, values = probe_rows(probe_path)
    states = {"observation": observations, "goal": goals}
    compare("actions in arbitrary states", actor.run(["action"], states)[0], actions, ARBITRARY_TOLERANCE)
    got = critic.run(["value"], states | {"action": actions})[0]
    compare("values of these actions", got, values, ARBITRARY_TOLERANCE)
    one = {name: rows[:1] for name, rows in states.items()}
    compare("actions of a batch of one", actor.run(["action"], one)[0], actions[:1], ARBITRARY_TOLERANCE)
    observations, goals, actions = log_rows(log_directory)
    states = {"observation": observations, "goal": goals}
    compare("actions in simulated states", actor.run(["action"], states)[0], actions, SIMULATED_TOLERANCE)


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit(__doc__)
    main(*sys.argv[1:])
