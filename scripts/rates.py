#!/usr/bin/env python3
"""Prints how often policies succeed if the rates in their observations come from differences of two measurements.

    python scripts/rates.py policies/student-push.safetensors policies/student-pick-and-place.safetensors

Needs: pip install ./python
"""

import argparse

import gymnasium
import numpy as np
import tandem

N_STEPS = 50
# Places of an arm's observation: openings of the fingers, all rates, rates of the fingers.
OPENINGS, RATES, FINGER_RATES = slice(9, 12), slice(16, 28), slice(25, 28)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="+", metavar="POLICY")
    parser.add_argument("--episodes", type=int, default=100, help="episodes of each row [default: 100]")
    options = parser.parse_args()
    policies = [tandem.load_policy(path) for path in options.policies]
    print(f"| rates | {' | '.join(policy.task for policy in policies)} |\n|---|{'---|' * len(policies)}")
    for name, rates in VARIANTS.items():
        counts = [n_successes(policy, rates, options.episodes) for policy in policies]
        print(f"| {name} | {' | '.join(map(str, counts))} |", flush=True)


def n_successes(policy, rates, n_episodes):
    """Returns the number of successes in episode 0 of seeds 1 to `n_episodes`."""
    env, count = gymnasium.make(policy.env_id), 0
    for seed in range(1, n_episodes + 1):
        seen, info = env.reset(seed=seed)
        before = seen["observation"].reshape(-1, 28)
        for _ in range(N_STEPS):
            now = seen["observation"].reshape(-1, 28)
            observation = now.copy()
            rates(observation, before)
            action, _ = policy.predict({**seen, "observation": observation.ravel()})
            seen, _, _, _, info = env.step(action)
            before = now
        count += info["is_success"]
    return count


def differences(now, before):
    """Replaces the rates by differences: object less tool, turn, tool and openings."""
    tool, thing, opening = (now[:, part] - before[:, part] for part in (slice(0, 3), slice(3, 6), OPENINGS))
    v, w, u, d = now[:, 12:15], now[:, 15:16], before[:, 12:15], before[:, 15:16]
    sign = np.sign(w * d + (v * u).sum(axis=1, keepdims=True))
    turn = 2 * sign * (d * v - w * u - np.cross(v, u))
    now[:, RATES] = np.concatenate([thing - tool, turn, tool, opening], axis=1)


def differences_without_fingers(now, before):
    differences(now, before)
    now[:, FINGER_RATES] = 0


def none(now, before):
    now[:, RATES] = 0


VARIANTS = {
    "those of the simulator": lambda now, before: None,
    "differences of two measurements": differences,
    "the same, 0 for the fingers": differences_without_fingers,
    "0": none,
}

if __name__ == "__main__":
    main()
