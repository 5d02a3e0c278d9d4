#!/usr/bin/env python3
"""Plays policies in MuJoCo, in the same scene and on the same goals as the simulator, without retraining.

Prints a table with the success rates in both engines. docs/transfer.md describes the method.
"""

import argparse
import json
import math
import multiprocessing
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

import numpy as np

from check_policy import inputs, network, read
from mujoco_world import ARM_ARM, ContactModel, MujocoWorld

ROOT = Path(__file__).resolve().parent.parent
SHIPPED = [
    ROOT / "policies" / f"{role}-{task}{world}.safetensors"
    for world in ("", "-classic")
    for task in ("push", "pick-and-place")
    for role in ("student", "teacher")
] + [ROOT / "policies" / "student-carry-bar.safetensors"]
# For each world the control steps in which hands rise above the objects before their free motion is compared.
RISING_STEPS = {"shared": 2, "classic": 5}
# Tasks and numbers of arms whose motion without contact is compared.
FREE_MOTIONS = [("push", 1), ("pick-and-place", 1), ("pick-and-place", 2)]
EXAMPLES = """examples:
  python scripts/mujoco_transfer.py                               all shipped policies, 240 goals each
  python scripts/mujoco_transfer.py policies/student-push.safetensors --episodes 60 --json
  python scripts/mujoco_transfer.py policies/teacher-push.safetensors --arms 2     two copies of the teacher
  python scripts/mujoco_transfer.py --check                       compares the engines without policies
  python scripts/mujoco_transfer.py --mujoco-defaults             with MuJoCo's own contact parameters

The tandem program must be built: cargo build --release. Packages: pip install -r scripts/requirements-mujoco.txt
"""


class Wrong(Exception):
    """An error that is reported in one line."""


class Policy:
    """A policy file in NumPy. A one-arm policy acts for each arm of a layout separately."""

    def __init__(self, path):
        self.metadata, self.tensors = read(str(path))
        self.n_arms = int(self.metadata["n_arms"])
        self.n_layers = int(self.metadata["n_hidden_layers"]) + 1

    def act(self, observation, goal):
        """Actions in [-1, 1] for an observation [28 * n] and a goal [3 * n] of n arms."""
        n_rows = len(observation) // (28 * self.n_arms)
        rows = inputs(self.metadata, self.tensors, observation.reshape(n_rows, -1), goal.reshape(n_rows, -1))
        return np.tanh(network(self.tensors, "actor", self.n_layers, rows)).ravel()


def tandem(program, *arguments, command=("scene", "--json")):
    """The JSON that `tandem scene`, or another command, prints with `arguments`."""
    command = [str(program), *command, *map(str, arguments)]
    try:
        done = subprocess.run(command, capture_output=True, check=True, text=True)
    except FileNotFoundError:
        raise Wrong(f"{program} does not exist: build it with `cargo build --release`, or give --tandem") from None
    except subprocess.CalledProcessError as error:
        raise Wrong(error.stderr.strip() or f"{program} ended with {error.returncode}") from None
    return json.loads(done.stdout)


def wilson(hits, n):
    """Wilson's 95 % interval of a share."""
    z = 1.959963984540054
    share = hits / n
    centre, scale = share + z * z / (2 * n), 1 + z * z / n
    spread = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def goal_distances(world, observations, goal):
    """The distance of every object to its goal, metres, [steps, arms]."""
    things = np.reshape(observations, (len(observations), len(world["arms"]), 28))[:, :, 3:6]
    return np.linalg.norm(things - np.reshape(goal, (-1, 3)), axis=2)


def manipulation(world, program):
    """What success needs beyond the distances to the goals, from the description of the task: the number of last steps
    after which it must hold, and conditions on the observation.
    """
    if world["task"] != "carry-bar":
        return 1, []
    description = tandem(program, "--describe", "--task", "carry-bar", command=("env",))["manipulation"]
    arms = description["arms"]
    return description["success_steps"], [one for arm in arms for one in (*arm["holding"], *arm["conditions"])]


def holds(condition, observations):
    """Whether numbers of each observation are within the tolerance of their target; without one, of zero."""
    numbers = observations[:, condition["numbers"]]
    return np.linalg.norm(numbers - (condition["target"] or 0.0), axis=1) <= condition["tolerance"]


def play(world_in_mujoco, episode, choose_action):
    """The observations of an episode [steps + 1, n_observation], and the contacts of its steps."""
    world_in_mujoco.reset(episode["observations"][0])
    observations, contacts = [world_in_mujoco.observe()], []
    for step in range(len(episode["actions"])):
        contacts.append(world_in_mujoco.step(choose_action(step, observations[-1])))
        observations.append(world_in_mujoco.observe())
    return np.array(observations), contacts


def start_process(world, contact, path):
    global mujoco_world, policy
    mujoco_world, policy = MujocoWorld(world, contact), Policy(path) if path else None


def play_policy(episode):
    goal = np.array(episode["goal"])
    return play(mujoco_world, episode, lambda _, observation: policy.act(observation, goal))


def play_actions(episode):
    return play(mujoco_world, episode, lambda step, _: np.array(episode["actions"][step]))


def play_all(scene, contact, path, how, label, arguments):
    """Plays all episodes of `scene`, in order, and reports progress."""
    results = []
    start = (scene["world"], contact, path)
    with multiprocessing.get_context("spawn").Pool(arguments.processes, start_process, start) as pool:
        for result in pool.imap(how, scene["episodes"], chunksize=4):
            results.append(result)
            if len(results) % 20 == 0 or len(results) == len(scene["episodes"]):
                print(f"{label}: {len(results)} of {len(scene['episodes'])} episodes", file=sys.stderr)
    return results


def summary(successes, contacts):
    """Shares of episodes, from their successes and the contacts of their steps. `touched` is about the arms."""
    n = len(successes)
    touched = [any(ARM_ARM in kinds for kinds in steps) for steps in contacts]
    clean = [success and not touch for success, touch in zip(successes, touched)]
    (low, high), (clean_low, clean_high) = (wilson(sum(hits), n) for hits in (successes, clean))
    return {
        "success": sum(successes) / n,
        "success_low": low,
        "success_high": high,
        "success_without_arm_contact": sum(clean) / n,
        "success_without_arm_contact_low": clean_low,
        "success_without_arm_contact_high": clean_high,
        "arm_contact_rate": sum(touched) / n,
        "collision_rate": sum(any(steps) for steps in contacts) / n,
    }


def transfer(path, arguments):
    """Success of one policy in both engines, on the same goals."""
    one_arm = Policy(path).n_arms == 1 and arguments.arms == 2
    actor = "--composed-teachers" if one_arm else "--policy"
    scene = tandem(arguments.tandem, actor, path, "--episodes", arguments.episodes, "--seed", arguments.seed)
    world = scene["world"]
    label = f"{world['task']}, {'2 copies of ' if one_arm else ''}{path.stem.split('-')[0]}"
    played = play_all(scene, contact_model(arguments), path, play_policy, label, arguments)

    n_steps, conditions = manipulation(world, arguments.tandem)

    def achieved(observations, goal):
        last = np.array(observations[-n_steps:])
        is_near = (goal_distances(world, last, goal) <= world["goal_tolerance_m"]).all()
        return bool(is_near and all(holds(condition, last).all() for condition in conditions))

    goals = [episode["goal"] for episode in scene["episodes"]]
    in_rapier = [achieved(episode["observations"], goal) for episode, goal in zip(scene["episodes"], goals)]
    in_mujoco = [achieved(observations, goal) for (observations, _), goal in zip(played, goals)]
    return {
        "task": world["task"],
        "arms": len(world["arms"]),
        "policy": str(path.relative_to(ROOT) if path.is_relative_to(ROOT) else path),
        "episodes": len(goals),
        "seed": arguments.seed,
        "rapier": summary(in_rapier, [episode["contacts"] for episode in scene["episodes"]]),
        "mujoco": summary(in_mujoco, [contacts for _, contacts in played]),
        "only_rapier": [idx for idx, pair in enumerate(zip(in_rapier, in_mujoco)) if pair == (True, False)],
        "only_mujoco": [idx for idx, pair in enumerate(zip(in_rapier, in_mujoco)) if pair == (False, True)],
    }


def print_transfer(results):
    """Prints the rates as a table; "no contact" is success in an episode in which the arms do not touch each other."""
    columns = "success | 95 % interval | no contact | 95 % interval"
    engines = " | ".join(f"{engine} {columns}" for engine in ("rapier", "MuJoCo"))
    print(f"| task | arms | policy | {engines} |")
    print("|" + 11 * "---|")
    for result in results:
        cells = [result["task"], str(result["arms"]), Path(result["policy"]).stem]
        for engine in ("rapier", "mujoco"):
            rates = result[engine]
            for rate in ("success", "success_without_arm_contact"):
                cells += [f"{rates[rate]:.3f}", f"{rates[f'{rate}_low']:.3f}–{rates[f'{rate}_high']:.3f}"]
        print("| " + " | ".join(cells) + " |")


def free_motion(task, n_arms, n_episodes, n_rising, n_steps=50):
    """Random actions of hands that rise for `n_rising` steps and then stay above the objects,
    [episodes][steps][n_action].
    """
    rng = np.random.default_rng(1)
    n_action = 4 if task == "pick-and-place" else 3
    held = rng.uniform(-1.0, 1.0, (n_episodes, n_steps // 5, n_arms, n_action))
    actions = np.repeat(held, 5, axis=1)
    actions[:, :, :, 2] = 0.0
    actions[:, :n_rising, :, 0:2], actions[:, :n_rising, :, 2] = 0.0, 1.0
    return actions.reshape(n_episodes, n_steps, -1)


def differences(scene, played, columns):
    """Norms of the differences between the engines in some numbers of every arm, [episodes, steps + 1, arms]."""
    n_arms = len(scene["world"]["arms"])

    def split(rows):
        return np.reshape(rows, (len(rows), n_arms, 28))[:, :, columns]

    return np.array(
        [
            np.linalg.norm(split(episode["observations"]) - split(observations), axis=2)
            for episode, (observations, _) in zip(scene["episodes"], played)
        ]
    )


def check(arguments):
    """Compares the engines under equal actions: hands and grippers without contact, then recorded episodes."""
    contact, n_episodes, rows = contact_model(arguments), min(arguments.episodes, 40), []

    def compare(what, scene, quantities):
        played = play_all(scene, contact, None, play_actions, what, arguments)
        for name, columns in quantities:
            norms = differences(scene, played, columns)
            last = norms[:, -1].max(axis=1)
            rows.append(
                {
                    "actions": what,
                    "quantity": name,
                    "episodes": len(norms),
                    "all_steps_median_mm": 1e3 * float(np.median(norms)),
                    "last_step_median_mm": 1e3 * float(np.median(last)),
                    "last_step_90_percent_mm": 1e3 * float(np.quantile(last, 0.9)),
                    "largest_mm": 1e3 * float(norms.max()),
                }
            )

    hand, thing, openings = ("hand", slice(0, 3)), ("object", slice(3, 6)), ("openings", slice(9, 12))
    for (world, n_rising), (task, n_arms) in product(RISING_STEPS.items(), FREE_MOTIONS):
        with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
            json.dump(free_motion(task, n_arms, n_episodes, n_rising).tolist(), file)
            file.flush()
            options = ["--task", task, "--world", world, "--arms", n_arms, "--actions", file.name]
            scene = tandem(arguments.tandem, *options, "--seed", arguments.seed)
        quantities = [hand, openings] if task == "pick-and-place" else [hand]
        compare(f"{scene['world']['task']}, {n_arms} arm(s), no contact", scene, quantities)
    for path in SHIPPED:
        options = ["--policy", path, "--episodes", n_episodes, "--seed", arguments.seed]
        scene = tandem(arguments.tandem, *options)
        quantities = [hand, openings, thing] if scene["world"]["arms"][0]["fingers"] else [hand, thing]
        compare(f"{scene['world']['task']}, actions of the {path.stem.split('-')[0]} in rapier", scene, quantities)
    return rows


def print_check(rows):
    print(
        "| difference in mm, actions | quantity | all steps, median | last step, median | last step, 90 % | largest |"
    )
    print("|---|---|---|---|---|---|")
    for row in rows:
        values = [
            row[key] for key in ("all_steps_median_mm", "last_step_median_mm", "last_step_90_percent_mm", "largest_mm")
        ]
        print(f"| {row['actions']} | {row['quantity']} | " + " | ".join(f"{value:.2f}" for value in values) + " |")


def contact_model(arguments):
    if arguments.mujoco_defaults:
        return ContactModel(time_constant_s=0.02, cone="pyramidal", impratio=1.0, refinement=arguments.refinement)
    return ContactModel(arguments.time_constant, arguments.cone, arguments.impratio, arguments.refinement)


def parse(argv):
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = ContactModel()
    parser.add_argument(
        "policies", nargs="*", type=Path, metavar="FILE", help="policies [default: the nine shipped ones]"
    )
    parser.add_argument("--arms", type=int, choices=(1, 2), help="2: one-arm policies control two arms, each its own")
    parser.add_argument("--episodes", type=int, default=240, help="goals per policy [default: 240]")
    parser.add_argument("--seed", type=int, default=780, help="seed of the goals, as in tandem eval [default: 780]")
    parser.add_argument(
        "--check", action="store_true", help="compare the engines under equal actions, at most 40 episodes per row; mm"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON array instead of a table")
    parser.add_argument("--tandem", type=Path, default=ROOT / "target/release/tandem", help="the tandem program")
    parser.add_argument("--processes", type=int, default=2, help="processes that simulate [default: 2]")
    contact = parser.add_argument_group("contacts in MuJoCo")
    contact.add_argument("--mujoco-defaults", action="store_true", help="0.02 s, pyramidal, 1: MuJoCo's own values")
    contact.add_argument(
        "--time-constant",
        type=float,
        default=default.time_constant_s,
        metavar="S",
        help="time constant of contacts, s [default: %(default)s]",
    )
    contact.add_argument(
        "--cone", choices=("elliptic", "pyramidal"), default=default.cone, help="[default: %(default)s]"
    )
    contact.add_argument(
        "--impratio", type=float, default=default.impratio, help="frictional to normal impedance [default: %(default)s]"
    )
    contact.add_argument(
        "--refinement", type=int, default=1, metavar="N", help="divide MuJoCo's step by N [default: 1]"
    )
    arguments = parser.parse_args(argv)
    for name in ("episodes", "processes", "refinement"):
        if getattr(arguments, name) < 1:
            parser.error(f"--{name} must be 1 or more")
    return arguments


def main(argv):
    arguments = parse(argv)
    if arguments.check:
        results, show = check(arguments), print_check
    else:
        paths = [path.resolve() for path in arguments.policies] or SHIPPED
        missing = [str(path) for path in paths if not path.is_file()]
        if missing:
            raise Wrong(f"no such policy: {', '.join(missing)}")
        results, show = [transfer(path, arguments) for path in paths], print_transfer
    print(json.dumps(results)) if arguments.json else show(results)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except Wrong as error:
        sys.exit(f"mujoco_transfer: {error}")
