"""Measures what Python adds to a step of the simulator: `python benchmarks/step.py`.

Prints for each environment

- the duration of a step in Rust, with its observation and reward (`Simulation.play`, which loops in Rust),
- the duration of `TandemEnv.step` and its ratio to that of Rust,
- the overhead: the duration of `TandemEnv.step` with everything but the physics (`Simulation.step_without_physics`).
  It is an upper bound, because it includes the observation and the reward. The difference of the two durations above
  cannot show it: it is smaller than their variation.
- the same within the wrappers that `gymnasium.make` adds.

They are measured in turn, in processor time of the thread, so that other processes disturb them little. A duration is
the median of all blocks, a ratio the median of the ratios of neighbouring blocks, an overhead that of the fastest block.
"""

import argparse
import statistics
import time

import gymnasium
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

import tandem
from tandem.envs import EPISODE_STEPS

N_IDLE_STEPS = 2000


class _WithoutPhysics(tandem.TandemEnv):
    """An environment whose steps do everything but the physics."""

    def step(self, action):
        return self._simulation.step_without_physics(action)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=40, help="blocks of 50 steps for each figure")
    n_blocks = parser.parse_args().blocks
    print(f"{'µs per step':30} {'Rust':>8} {'Python':>8} {'ratio':>7} {'overhead':>9} {'with wrappers':>14}")
    for env_id, spec in gymnasium.registry.items():
        if spec.entry_point == "tandem.envs:TandemEnv":
            print(f"{env_id:30} {row(spec.kwargs, n_blocks)}", flush=True)


def row(kwargs: dict, n_blocks: int) -> str:
    env, idle = tandem.TandemEnv(**kwargs), _WithoutPhysics(**kwargs)
    wrapped = TimeLimit(OrderEnforcing(PassiveEnvChecker(_WithoutPhysics(**kwargs))), 10**9)
    shape = (EPISODE_STEPS, *env.action_space.shape)
    rng = np.random.default_rng(1)
    in_rust, in_python, overhead, with_wrappers = [], [], [], []
    idle.reset(seed=1)
    wrapped.reset(seed=1)
    for seed in range(n_blocks):
        actions = rng.uniform(-1, 1, shape).astype(np.float32)
        env.reset(seed=seed)
        in_rust.append(duration_us(lambda: env._simulation.play(actions)) / EPISODE_STEPS)
        rows = list(actions)
        env.reset(seed=seed)
        in_python.append(duration_us(lambda: [env.step(action) for action in rows]) / EPISODE_STEPS)
        overhead.append(duration_us(lambda: repeat(idle, rows[0])) / N_IDLE_STEPS)
        with_wrappers.append(duration_us(lambda: repeat(wrapped, rows[0])) / N_IDLE_STEPS)
    rust, python = statistics.median(in_rust), statistics.median(in_python)
    ratio = statistics.median(one / other for one, other in zip(in_python, in_rust, strict=True))
    return f"{rust:8.1f} {python:8.1f} {ratio:7.3f} {min(overhead):9.2f} {min(with_wrappers):14.2f}"


def repeat(env: gymnasium.Env, action: np.ndarray) -> None:
    for _ in range(N_IDLE_STEPS):
        env.step(action)


def duration_us(call) -> float:
    start = time.thread_time_ns()
    call()
    return (time.thread_time_ns() - start) / 1000


if __name__ == "__main__":
    main()
