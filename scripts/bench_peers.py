#!/usr/bin/env python3
"""Times other projects and Tandem in turn on one core: gymnasium-robotics' Fetch environments and PyTorch's DDPG update.

Usage: python scripts/bench_peers.py [--tandem target/release/tandem] [--rounds 3]
Needs: pip install './python[fetch]', and torch for the update.
Prints one JSON object a line (name, value, unit), then the ratios. A peer that is not installed is left out, and said so.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")

SECONDS = 3.0
BATCH, HIDDEN, LAYERS, OBSERVATION, GOAL, ACTION, HEADS = 256, 256, 4, 56, 6, 6, 2


def per_second(work, seconds=SECONDS):
    """Returns calls of `work` per second, after a warm-up call."""
    work()
    start, calls = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        work()
        calls += 1
    return calls / (time.perf_counter() - start)


def fetch(name):
    """Returns environment steps per second of a Fetch environment with random actions, resets included."""
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(name)
    env.reset(seed=1)

    def episode():
        env.reset()
        for _ in range(50):
            env.step(env.action_space.sample())

    return 50 * per_second(episode)


def torch_update():
    """Returns DDPG updates per second in PyTorch with one thread and fused Adam, on the student's networks."""
    import copy

    import torch
    from torch import nn

    torch.set_num_threads(1)

    def mlp(n_in, n_out):
        sizes = [n_in] + [HIDDEN] * LAYERS
        layers = [layer for a, b in zip(sizes, sizes[1:]) for layer in (nn.Linear(a, b), nn.ReLU())]
        return nn.Sequential(*layers, nn.Linear(HIDDEN, n_out))

    actor, critic = mlp(OBSERVATION + GOAL, ACTION), mlp(OBSERVATION + GOAL + ACTION, HEADS)
    target_actor, target_critic = copy.deepcopy(actor), copy.deepcopy(critic)
    adam_a = torch.optim.Adam(actor.parameters(), lr=1e-3, fused=True)
    adam_c = torch.optim.Adam(critic.parameters(), lr=1e-3, fused=True)
    s, s2 = torch.rand(BATCH, OBSERVATION + GOAL), torch.rand(BATCH, OBSERVATION + GOAL)
    a, r, bc_mask = torch.rand(BATCH, ACTION), -torch.ones(BATCH, HEADS), torch.zeros(BATCH, ACTION)

    def update():
        with torch.no_grad():
            y = (r + 0.95 * target_critic(torch.cat([s2, torch.tanh(target_actor(s2))], 1))).clamp(-20, 0)
        loss_c = ((critic(torch.cat([s, a], 1)) - y) ** 2).sum(1).mean()
        adam_c.zero_grad()
        grads_c = torch.autograd.grad(loss_c, list(critic.parameters()))
        u = torch.tanh(actor(s))
        loss_a = -critic(torch.cat([s, u], 1)).sum(1).mean() + 0.1 * (u**2).mean()
        loss_a = loss_a + 2.0 * (bc_mask * (u - a) ** 2).sum(1).mean()
        grads_a = torch.autograd.grad(loss_a, list(actor.parameters()))
        for net, grads, adam in ((critic, grads_c, adam_c), (actor, grads_a, adam_a)):
            for p, g in zip(net.parameters(), grads):
                p.grad = g
            adam.step()
        with torch.no_grad():
            for net, target in ((critic, target_critic), (actor, target_actor)):
                torch._foreach_lerp_(list(target.parameters()), list(net.parameters()), 0.05)

    return per_second(update)


def tandem(program):
    """Returns Tandem's figures by name."""
    try:
        output = subprocess.run([program, "bench", "sim", "update", "--json"], stdout=subprocess.PIPE, text=True)
    except OSError as error:
        sys.exit(f"bench_peers: cannot run {program}: {error.strerror}; cargo build --release makes it")
    if output.returncode != 0:
        sys.exit(f"bench_peers: {program} bench ended with exit code {output.returncode}")
    return {row["name"]: row["value"] for row in map(json.loads, output.stdout.splitlines())}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    program = Path(__file__).resolve().parents[1] / "target/release/tandem"
    parser.add_argument("--tandem", default=str(program), help="the program [default: that of this checkout]")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    peers = {
        "fetch-push": (lambda: fetch("FetchPush-v4"), "sim/push/1-arm", "env steps/s"),
        "fetch-pick-and-place": (lambda: fetch("FetchPickAndPlace-v4"), "sim/pick-and-place/1-arm", "env steps/s"),
        "torch-fused-adam": (torch_update, "update/student/1-thread", "updates/s"),
    }
    seen, absent = {}, set()
    for _ in range(args.rounds):
        ours = tandem(args.tandem)
        for peer, (measure, own, unit) in peers.items():
            if peer in absent:
                continue
            try:
                value = measure()
            except ImportError as error:
                print(f"{peer} left out: {error}")
                absent.add(peer)
                continue
            print(json.dumps({"name": peer, "value": round(value, 1), "unit": unit}))
            print(json.dumps({"name": own, "value": round(ours[own], 1), "unit": unit}))
            seen.setdefault(peer, []).append(ours[own] / value)
    for peer, ratios in seen.items():
        low, middle, high = min(ratios), statistics.median(ratios), max(ratios)
        print(f"{peers[peer][1]} is {middle:.2f} x {peer} (median of {len(ratios)}, {low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
