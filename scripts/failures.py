#!/usr/bin/env python3
"""How a policy with several arms fails: plays episodes and counts what the arms without success did.

A goal is *raised* if it is more than the tolerance, 5 cm, above its object: it cannot be reached by pushing.

An arm *touched* its object if the object ends more than 2 cm from its start, and is *at* it if its hand ends within
5 cm of it. An arm that neither touched its object nor is at it has usually waited for another arm. The value is the
mean of the critic's over these arms after half of the steps: without contacts, minus the discounted number of steps
until success. The value of waiting forever is -1 / (1 - discount).
"""

import argparse
import sys

import gymnasium
import numpy as np

import tandem

MOVED_M = 0.02
NEAR_M = 0.05
EXAMPLES = """examples:
  python scripts/failures.py policies/student-pick-and-place.safetensors
  python scripts/failures.py runs/a/policy/best.safetensors --episodes 4000 --seed 20000

Needs: pip install ./python
"""


def play(policy, n_envs, seed):
    """Plays an episode in each environment. Returns starts, ends, goals and hands, each [n_envs, n_arms, 3], metres in
    the arms' frames, and the critic's values after half of the steps, [n_envs, n_arms]."""
    envs = gymnasium.make_vec(policy.env_id, num_envs=n_envs)
    n_steps = envs.spec.max_episode_steps
    observation, _ = envs.reset(seed=seed)

    def places(values):
        return values.reshape(n_envs, policy.n_arms, -1)[:, :, :3].copy()

    starts = places(observation["achieved_goal"])
    for step in range(n_steps):
        action, _ = policy.predict(observation)
        if step == n_steps // 2:
            # A critic with one value for all arms expects the same of each.
            values = np.broadcast_to(policy.q(observation, action), (n_envs, policy.n_arms))
        observation, *_ = envs.step(action)
    ends, goals = places(observation["achieved_goal"]), places(observation["desired_goal"])
    # The first three numbers of an arm's observation are the place of its hand.
    return starts, ends, goals, places(observation["observation"]), values


def distances(some, others):
    """Returns the distances between places, [n_envs, n_arms], metres."""
    return np.linalg.norm(some - others, axis=2)


def count(starts, ends, goals, hands, values, tolerance_m):
    """Returns the failed episodes, also by their raised goals, and, of the arms without success, how many touched their
    objects and are at them."""
    failed = distances(ends, goals) > tolerance_m
    n_raised = (goals[:, :, 2] - starts[:, :, 2] > tolerance_m).sum(axis=1)
    by_raised = {
        f"{counted} with {n} raised goals": int((is_counted & (n_raised == n)).sum())
        for n in range(failed.shape[1] + 1)
        for counted, is_counted in (("episodes", True), ("failed episodes", failed.any(axis=1)))
    }
    touched, near = distances(starts, ends) > MOVED_M, distances(hands, ends) < NEAR_M
    waiting = failed & ~touched & ~near
    return {
        "episodes": len(failed),
        "failed episodes": int(failed.any(axis=1).sum()),
        **by_raised,
        "arms without success": int(failed.sum()),
        "object not touched, hand away": int(waiting.sum()),
        "object not touched, hand at it": int((failed & ~touched & near).sum()),
        "object touched, hand away": int((failed & touched & ~near).sum()),
        "object touched, hand at it": int((failed & touched & near).sum()),
        "value of arms whose object is not touched, hand away": round(float(values[waiting].mean()), 1)
        if waiting.any()
        else None,
    }


def positive(text):
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text}: expected 1 or more")
    return number


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", help="policy file for push or pick-and-place")
    parser.add_argument("--episodes", type=positive, default=2000, help="number of episodes [default: 2000]")
    parser.add_argument("--seed", type=int, default=10_000, help="seed of the starts and goals [default: 10000]")
    args = parser.parse_args()
    try:
        policy = tandem.load_policy(args.policy)
        policy.env_id  # Raises an error for a task of another simulator.
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    if "carry-bar" in policy.task:
        sys.exit("error: carry-bar has one object for both arms: expected a policy for push or pick-and-place")
    for name, value in count(*play(policy, args.episodes, args.seed), tolerance_m=0.05).items():
        print(f"{'–' if value is None else value:>6}  {name}")


if __name__ == "__main__":
    main()
