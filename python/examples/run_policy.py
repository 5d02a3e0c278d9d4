"""Runs a shipped policy in its environment and prints the success rate: `python examples/run_policy.py POLICY`."""

import sys

import gymnasium

import tandem

policy = tandem.load_policy(sys.argv[1])
envs = gymnasium.make_vec(policy.env_id, num_envs=100)
observations, infos = envs.reset(seed=1)
for _ in range(50):
    actions, _ = policy.predict(observations)
    observations, rewards, terminations, truncations, infos = envs.step(actions)
print(f"success rate {infos['is_success'].mean():.2f} over 100 episodes")
