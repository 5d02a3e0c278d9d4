#!/usr/bin/env python3
"""Reads recorded episodes with the MCAP project's own reader and checks that they hold what they should.

    python scripts/read_mcap.py EPISODE.mcap...

Prints a line for each channel. Ends with code 1 and one line on standard error when anything is off.
Needs the packages of scripts/requirements.txt.
"""

import argparse
import json
import math
import sys
from collections import defaultdict

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

METADATA_KEYS = "format run episode seed kind parameter_version task arms policy_digest".split()
ACTION_PER_ARM = {"push": 3, "pick-and-place": 4, "shared-push": 3, "shared-pick-and-place": 4, "carry-bar": 4}


class Wrong(Exception):
    """An error that is reported in one line."""


class Task:
    """The sizes of a task, from the metadata of its log."""

    def __init__(self, metadata):
        self.name, self.n_arms = metadata["task"], int(metadata["arms"])
        self.is_built_in = metadata["format"] == "1"
        if self.is_built_in:
            expect(self.name in ACTION_PER_ARM, f"unknown task {self.name!r}")
            sizes = 28, 3, ACTION_PER_ARM[self.name]
            self.n_observation, self.n_goal, self.n_action = (self.n_arms * size for size in sizes)
            self.n_steps, self.has_scene = 50, True
            return
        expect("description" in metadata, "metadata lacks description")
        description = json.loads(metadata["description"])
        self.n_observation, self.n_goal = description["n_observation"], description["n_goal"]
        self.n_action, self.n_steps = description["n_action"], description["episode_steps"]
        goals = [arm["goal"] for arm in description["arms"]]
        goals.append(set(range(self.n_goal)).difference(*goals))
        self.has_scene = any(len(goal) in (2, 3) for goal in goals)

    def channels(self):
        """Topic -> schema and number of messages: one before each step, and for the world one more at the end."""
        world = {"/scene": "foxglove.SceneUpdate"} if self.has_scene else {}
        if self.is_built_in:
            world |= {"/tf": "foxglove.FrameTransforms", "/joint_states": "foxglove.JointStates"}
        steps = {"/transition": "tandem.Transition", "/stats": "tandem.Stats"}
        channels = {topic: (schema, self.n_steps + 1) for topic, schema in world.items()}
        channels |= {topic: (schema, self.n_steps) for topic, schema in steps.items()}
        return channels | {"/outcome": ("tandem.Outcome", 1)}


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
    return Task(metadata)


def check_channels(channels, task):
    for topic, (schema, n_messages) in task.channels().items():
        expect(topic in channels, f"no messages on {topic}")
        got_schema, times, messages = channels[topic]
        expect(got_schema == schema, f"{topic} has schema {got_schema}, expected {schema}")
        expect(len(messages) == n_messages, f"{topic} has {len(messages)} messages, expected {n_messages}")
        expect(times == sorted(times), f"times on {topic} go backwards")


def check_transitions(transitions, task):
    for step, transition in enumerate(transitions):
        expect(transition.step == step, f"transition {step} calls itself step {transition.step}")
        lengths = {
            "observation": task.n_observation,
            "goal": task.n_goal,
            "action": task.n_action,
            "rewards_per_arm": task.n_arms,
        }
        if hasattr(transition, "achieved_goal"):  # logs of earlier versions do not have it
            lengths["achieved_goal"] = task.n_goal
        for field, expected in lengths.items():
            numbers = getattr(transition, field)
            expect(len(numbers) == expected, f"step {step}: {field} has {len(numbers)} numbers, expected {expected}")
            expect(all(map(math.isfinite, numbers)), f"step {step}: {field} is not finite")
        expect(all(abs(a) <= 1 for a in transition.action), f"step {step}: action outside [-1, 1]")
        expect(transition.reward in (-1, 0), f"step {step}: reward {transition.reward}")


def check_goals(channels):
    for update in channels["/scene"][2]:
        drawn = {entity.id for entity in update.entities}
        goals = {name.removeprefix("goal") for name in drawn if name.startswith("goal")}
        expect(goals, "no goal in the scene")
        expect(all(f"achieved{goal}" in drawn for goal in goals), "no achieved goal in the scene")


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
    task = check_metadata(metadata)
    check_channels(channels, task)
    check_transitions(channels["/transition"][2], task)
    if task.is_built_in:
        check_world(channels, task.n_arms)
    elif task.has_scene:
        check_goals(channels)
    outcome = channels["/outcome"][2][0]
    n_last = len(outcome.observation)
    expect(n_last == task.n_observation, f"the last observation has {n_last} numbers")


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
