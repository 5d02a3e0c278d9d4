#!/usr/bin/env python3
"""Measures how often two arms of tandem/TwoFetchPush-v0 disturb each other: a scripted pusher drives one arm or both.

Plays the same starts and goals three times: with each arm alone, while the other one rests, and with both. For every
distance between the arms it prints the share of episodes in which an arm alone is successful, the share in which both
would be if they did not disturb each other, the share in which both are, and the share with a contact between the arms.
"""

import argparse
import json

import numpy as np

from tandem.two_fetch import TwoFetchEnv

EXAMPLES = """examples:
  python scripts/two_fetch_interference.py
  python scripts/two_fetch_interference.py --distances 0.2 --episodes 400 --json

Needs: pip install './python[fetch]'
"""
CLEAR_Z_M, LOW_Z_M = 0.49, 0.42
BEHIND_M, ASIDE_M, CATCH_UP_M = 0.08, 0.03, 0.035


class Pusher:
    """Lifts the hand over the cube, lowers it on the side away from the goal, and pushes."""

    def __init__(self):
        self.lowered = False

    def act(self, observation, goal):
        """Returns the action, shape [4], for the 25 numbers of one arm and its goal."""
        hand, cube = observation[:3], observation[3:6]
        way = goal[:2] - cube[:2]
        length = np.linalg.norm(way)
        if length < 0.015:
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
            reach = min(length, 0.04)
            target = np.append(cube[:2] + (reach - CATCH_UP_M) * ahead, LOW_Z_M)
        return np.append(np.clip((target - hand) / 0.035, -1, 1), 0.0)


def play(env, seed, driven):
    """Plays an episode in which the arms of `driven` act. Returns the success of each arm, and whether arms touched."""
    observation, _ = env.reset(seed=seed)
    pushers, touched = [Pusher(), Pusher()], False
    for _ in range(50):
        action = np.zeros(8)
        for arm in driven:
            own = observation["observation"][25 * arm : 25 * arm + 25]
            action[4 * arm : 4 * arm + 4] = pushers[arm].act(own, observation["desired_goal"][3 * arm : 3 * arm + 3])
        observation, _, _, _, info = env.step(action)
        touched |= info["arm_contact"]
    apart = (observation["achieved_goal"] - observation["desired_goal"]).reshape(2, 3)
    return np.linalg.norm(apart, axis=1) <= 0.05, touched


def measure(distance, n_episodes):
    env = TwoFetchEnv("push", distance=distance)
    alone, joint, expected, contacts = [], [], [], []
    for seed in range(n_episodes):
        own = [play(env, seed, [arm])[0][arm] for arm in range(2)]
        both, touched = play(env, seed, [0, 1])
        alone += own
        expected.append(all(own))
        joint.append(both.all())
        contacts.append(touched)
    shares = {"alone": alone, "both_if_independent": expected, "both": joint, "arm_contact": contacts}
    return {"distance_m": distance, "episodes": n_episodes, **{k: float(np.mean(v)) for k, v in shares.items()}}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--distances", type=float, nargs="+", default=[0.15, 0.2, 0.25, 0.3, 0.6], metavar="M")
    parser.add_argument("--episodes", type=int, default=200, metavar="N", help="per distance [default: 200]")
    parser.add_argument("--json", action="store_true", help="print a JSON object per distance")
    arguments = parser.parse_args()
    if not arguments.json:
        print("| distance | one arm alone | both, if independent | both | arms touch |")
        print("|---|---|---|---|---|")
    for distance in arguments.distances:
        result = measure(distance, arguments.episodes)
        if arguments.json:
            print(json.dumps(result), flush=True)
        else:
            names = ("alone", "both_if_independent", "both", "arm_contact")
            cells = [f"{result[name]:.2f}" for name in names]
            print(f"| {distance:g} m | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
