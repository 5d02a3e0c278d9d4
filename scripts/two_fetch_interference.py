#!/usr/bin/env python3
"""Measures how often two arms of tandem/TwoFetchPush-v0 disturb each other: a scripted pusher drives each arm.

Plays the same starts and goals twice: with the arms 3 m apart, where each one is alone, and over one table. For every
distance between the arms it prints the share of episodes in which an arm alone is successful, the share in which both
are although they are apart, the share in which both are over one table, and the share with a contact between the arms.
"""

import argparse
import json
import sys

import numpy as np

from tandem.two_fetch import TwoFetchEnv

EXAMPLES = """examples:
  python scripts/two_fetch_interference.py
  python scripts/two_fetch_interference.py --distances 0.2 --episodes 400 --json

Needs: pip install './python[fetch]'
"""
CLEAR_Z_M, LOW_Z_M, REACH_M = 0.49, 0.42, 0.055
BEHIND_M, ASIDE_M, CATCH_UP_M, NEAR_M = 0.08, 0.03, 0.035, 0.04


class Pusher:
    """Lifts the hand over the cube, lowers it on the side away from the goal, and pushes."""

    def __init__(self):
        self.lowered = False

    def act(self, observation, goal):
        """Returns the action, shape [4], for the 25 numbers of one arm and its goal."""
        hand, cube = observation[:3], observation[3:6]
        way = goal[:2] - cube[:2]
        length = np.linalg.norm(way)
        if length < NEAR_M:
            return np.zeros(4)
        ahead = way / length
        offset = hand[:2] - cube[:2]
        along, aside = offset @ ahead, np.linalg.norm(offset - (offset @ ahead) * ahead)
        behind = cube[:2] - BEHIND_M * ahead
        if self.lowered and (along > -0.005 or aside > ASIDE_M):
            self.lowered = False
        if not self.lowered:
            near = np.linalg.norm(hand[:2] - behind) < 0.02
            target = np.append(behind, LOW_Z_M if near else CLEAR_Z_M)
            if not near and hand[2] < CLEAR_Z_M - 0.025 and np.linalg.norm(offset) < 0.12:
                target[:2] = hand[:2]
            self.lowered = near and hand[2] < LOW_Z_M + 0.015
        else:
            reach = min(length, REACH_M)
            target = np.append(cube[:2] + (reach - CATCH_UP_M) * ahead, LOW_Z_M)
        return np.append(np.clip((target - hand) / 0.035, -1, 1), 0.0)


def play(env, objects, goals):
    """Plays an episode with the given starts. Returns the success of each arm, and whether the arms touched."""
    observation = env.start(objects, goals)
    pushers, touched = [Pusher(), Pusher()], False
    for _ in range(50):
        own = zip(pushers, observation["observation"].reshape(2, 25), goals)
        action = np.concatenate([pusher.act(numbers, goal) for pusher, numbers, goal in own])
        observation, _, _, _, info = env.step(action)
        touched |= info["arm_contact"]
    return np.linalg.norm(observation["achieved_goal"].reshape(2, 3) - goals, axis=1) <= 0.05, touched


def measure(distance, n_episodes):
    together, apart = TwoFetchEnv("push", distance=distance), TwoFetchEnv("push", distance=3.0, close_goals=False)
    alone, both_apart, both, contacts = [], [], [], []
    for seed in range(n_episodes):
        start, _ = together.reset(seed=seed)
        objects, goals = start["achieved_goal"].reshape(2, 3)[:, :2], start["desired_goal"].reshape(2, 3)
        successes, _ = play(apart, objects, goals)
        alone += list(successes)
        both_apart.append(successes.all())
        successes, touched = play(together, objects, goals)
        both.append(successes.all())
        contacts.append(touched)
    shares = {"alone": alone, "both_apart": both_apart, "both": both, "arm_contact": contacts}
    return {"distance_m": distance, "episodes": n_episodes, **{k: float(np.mean(v)) for k, v in shares.items()}}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--distances", type=float, nargs="+", default=[0.15, 0.2, 0.25], metavar="M")
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="per distance [default: 200]")
    parser.add_argument("--json", action="store_true", help="print a JSON object per distance")
    arguments = parser.parse_args()
    if not arguments.json:
        print("| distance | one arm, alone | both, apart | both, over one table | arms touch |")
        print("|---|---|---|---|---|")
    for distance in arguments.distances:
        try:
            result = measure(distance, arguments.episodes)
        except ValueError as error:
            sys.exit(f"error: {error}")
        if arguments.json:
            print(json.dumps(result), flush=True)
        else:
            names = ("alone", "both_apart", "both", "arm_contact")
            cells = [f"{result[name]:.2f}" for name in names]
            print(f"| {distance:g} m | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
