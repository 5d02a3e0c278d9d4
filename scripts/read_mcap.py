#!/usr/bin/env python3
"""Reads recorded episodes with the MCAP project's own reader and checks that they hold what they should.

    python scripts/read_mcap.py EPISODE.mcap...

Prints a line for each channel. Ends with code 1 and one line on standard error when anything is off.
Needs the packages of scripts/requirements.txt.
"""

import argparse
import math
import sys
from collections import defaultdict

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

STEPS = 50
OBSERVATION_PER_ARM = 28
GOAL_PER_ARM = 3
ACTION_PER_ARM = {"push": 3, "pick-and-place": 4}
METADATA_KEYS = "format run episode seed kind parameter_version task arms policy_digest".split()
# Channel -> schema and number of messages: one before each step, and for the world one more at the end.
CHANNELS = {
    "/scene": ("foxglove.SceneUpdate", STEPS + 1),
    "/tf": ("foxglove.FrameTransforms", STEPS + 1),
    "/joint_states": ("foxglove.JointStates", STEPS + 1),
    "/transition": ("tandem.Transition", STEPS),
    "/stats": ("tandem.Stats", STEPS),
    "/outcome": ("tandem.Outcome", 1),
}


class Wrong(Exception):
    """An error that is reported in one line."""


def expect(condition, problem):
    if not condition:
        raise Wrong(problem)


def read(path):
    """The metadata, and for each topic its schema's name, times in seconds and decoded messages."""
    channels = defaultdict(lambda: ("", [], []))
    with open(path, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            _, times, messages = channels[channel.topic]
            times.append(message.log_time * 1e-9)
            messages.append(decoded)
            channels[channel.topic] = (schema.name, times, messages)
    return metadata.get("tandem.episode"), dict(channels)


def check_metadata(metadata):
    expect(metadata is not None, "no metadata record tandem.episode")
    missing = [key for key in METADATA_KEYS if key not in metadata]
    expect(not missing, f"metadata lacks {', '.join(missing)}")
    expect(metadata["task"] in ACTION_PER_ARM, f"unknown task {metadata['task']!r}")
    return metadata["task"], int(metadata["arms"])


def check_channels(channels):
    for topic, (schema, n_messages) in CHANNELS.items():
        expect(topic in channels, f"no messages on {topic}")
        got_schema, times, messages = channels[topic]
        expect(got_schema == schema, f"{topic} has schema {got_schema}, expected {schema}")
        expect(len(messages) == n_messages, f"{topic} has {len(messages)} messages, expected {n_messages}")
        expect(times == sorted(times), f"times on {topic} go backwards")


def check_transitions(transitions, task, n_arms):
    for step, transition in enumerate(transitions):
        expect(transition.step == step, f"transition {step} calls itself step {transition.step}")
        lengths = {
            "observation": OBSERVATION_PER_ARM * n_arms,
            "goal": GOAL_PER_ARM * n_arms,
            "action": ACTION_PER_ARM[task] * n_arms,
            "rewards_per_arm": n_arms,
        }
        for field, expected in lengths.items():
            numbers = getattr(transition, field)
            expect(len(numbers) == expected, f"step {step}: {field} has {len(numbers)} numbers, expected {expected}")
            expect(all(map(math.isfinite, numbers)), f"step {step}: {field} is not finite")
        expect(all(abs(a) <= 1 for a in transition.action), f"step {step}: action outside [-1, 1]")
        expect(transition.reward in (-1, 0), f"step {step}: reward {transition.reward}")


def check_world(channels, n_arms):
    for update in channels["/scene"][2]:
        drawn = {entity.id: entity for entity in update.entities}
        for arm in range(n_arms):
            expect(f"arm{arm}" in drawn and drawn[f"arm{arm}"].cylinders, f"no arm{arm} in the scene")
            expect(f"object{arm}" in drawn and f"goal{arm}" in drawn, f"no object or goal of arm {arm} in the scene")
    for transforms in channels["/tf"][2]:
        frames = {transform.child_frame_id for transform in transforms.transforms}
        expect(all(f"arm{arm}/end_effector" in frames for arm in range(n_arms)), "an end effector has no frame")
    for states in channels["/joint_states"][2]:
        expect(len(states.joints) == 6 * n_arms, f"{len(states.joints)} joints, expected {6 * n_arms}")


def check(path):
    metadata, channels = read(path)
    for topic, (schema, times, messages) in sorted(channels.items()):
        print(f"{path}: {topic:<14} {schema:<25} {len(messages):>4} messages, {times[0]:.3f} s to {times[-1]:.3f} s")
    task, n_arms = check_metadata(metadata)
    check_channels(channels)
    check_transitions(channels["/transition"][2], task, n_arms)
    check_world(channels, n_arms)
    outcome = channels["/outcome"][2][0]
    n_last = len(outcome.observation)
    expect(n_last == OBSERVATION_PER_ARM * n_arms, f"the last observation has {n_last} numbers")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="+", metavar="EPISODE.mcap")
    for path in parser.parse_args().files:
        try:
            check(path)
        except Wrong as problem:
            sys.exit(f"{path}: {problem}")
        except Exception as error:  # whatever the reader says of a file that is none
            sys.exit(f"{path}: cannot be read: {type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
