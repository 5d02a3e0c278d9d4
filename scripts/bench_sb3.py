#!/usr/bin/env python3
"""Trains Stable-Baselines3 with hindsight experience replay on a Gymnasium goal environment, as a reference.

Writes DIRECTORY/progress.csv with a line per evaluation: env_steps, updates, wall_s, success, success_low,
success_high and processor_s. An evaluation plays the policy without exploration on fixed seeds. Success is the share of
episodes whose last step reports is_success. Both clocks include evaluations and, in a resumed run, the time before the
interruption; processor seconds are those of all threads and child processes.
"""

import argparse
import contextlib
import csv
import importlib
import json
import math
import os
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
from sb3_contrib import TQC
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise

for package in ("gymnasium_robotics", "panda_gym", "tandem"):
    with contextlib.suppress(ImportError):
        importlib.import_module(package)

EXAMPLES = """examples:
  python scripts/bench_sb3.py --algorithm tqc --env FetchPush-v4 --out runs/sb3/tqc-push-1 --max-hours 3
  python scripts/bench_sb3.py --algorithm ddpg --env FetchPickAndPlace-v4 --seed 2 --out runs/sb3/ddpg-pick-2
  python scripts/bench_sb3.py --resume --out runs/sb3/tqc-push-1 --max-hours 6
  python scripts/bench_sb3.py --starts --env FetchPush-v4     counts the goals that an idle arm has achieved already

settings:
  tqc   RL Baselines3 Zoo, hyperparams/tqc.yml, FetchPush-v1 and FetchPickAndPlace-v1: 3 x 512, batch 2048 (1024 for
        FetchPickAndPlace), discount 0.95, learning rate 0.001, tau 0.05, one update per env step
  ddpg  the zoo has no DDPG settings for these environments; those of OpenAI Baselines (her/experiment/config.py):
        3 x 256, batch 256, discount 0.98, learning rate 0.001, tau 0.05, noise 0.2; one update per env step

Packages: pip install -r scripts/requirements-benchmarks.txt
"""
FIELDS = ["env_steps", "updates", "wall_s", "success", "success_low", "success_high", "processor_s"]
HER = {
    "policy": "MultiInputPolicy",
    "buffer_size": 1_000_000,
    "learning_rate": 1e-3,
    "tau": 0.05,
    "learning_starts": 1000,
    "replay_buffer_class": HerReplayBuffer,
    "replay_buffer_kwargs": {"goal_selection_strategy": "future", "n_sampled_goal": 4},
}


def make_model(algorithm, env, env_id, seed, device):
    if algorithm == "tqc":
        batch_size = 1024 if "PickAndPlace" in env_id else 2048
        network = {"net_arch": [512, 512, 512], "n_critics": 2}
        return TQC(env=env, seed=seed, device=device, gamma=0.95, batch_size=batch_size, policy_kwargs=network, **HER)
    n_action = env.action_space.shape[0]
    noise = NormalActionNoise(np.zeros(n_action), np.full(n_action, 0.2))
    network = {"net_arch": [256, 256, 256]}
    return DDPG(
        env=env,
        seed=seed,
        device=device,
        gamma=0.98,
        batch_size=256,
        action_noise=noise,
        policy_kwargs=network,
        train_freq=1,
        gradient_steps=1,
        **HER,
    )


def make_env(env_id):
    try:
        return gymnasium.make(env_id)
    except gymnasium.error.Error as error:
        sys.exit(f"bench_sb3: {error}")


def processor_s():
    """Processor seconds of this process and of its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def wilson(hits, n):
    """Wilson's 95 % interval of a share."""
    z = 1.959963984540054
    share = hits / n
    centre, scale = share + z * z / (2 * n), 1 + z * z / n
    spread = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def evaluate(model, env, n_episodes, first_seed):
    """The number of episodes that end in success, with starts and goals of fixed seeds."""
    hits = 0
    for seed in range(first_seed, first_seed + n_episodes):
        observation, _ = env.reset(seed=seed)
        info, over = {}, False
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        hits += bool(info["is_success"])
    return hits


def count_starts(env, n_episodes, first_seed):
    """The number of evaluation episodes whose goal is achieved at the start."""
    hits = 0
    for seed in range(first_seed, first_seed + n_episodes):
        observation, info = env.reset(seed=seed)
        # The reward of these environments is 0 at the goal and -1 elsewhere.
        hits += bool(env.unwrapped.compute_reward(observation["achieved_goal"], observation["desired_goal"], info) >= 0)
    return hits


class Benchmark(BaseCallback):
    """Evaluates, records and saves the run at fixed numbers of env steps, and ends it in time."""

    def __init__(self, run, settings, env, clocks, max_hours):
        super().__init__()
        self.run, self.settings, self.env = run, settings, env
        self.start = time.monotonic() - clocks["wall_s"]
        self.processor_before_s = clocks.get("processor_s", 0.0)
        self.max_s = 3600 * max_hours
        self.next_evaluation = 0
        self.evaluated_at = -1

    def _on_training_start(self):
        every = self.settings["evaluate_every"]
        self.next_evaluation = (self.num_timesteps // every + 1) * every

    def _on_step(self):
        if self.num_timesteps >= self.next_evaluation:
            self.next_evaluation += self.settings["evaluate_every"]
            self.evaluate()
            if self.num_timesteps % self.settings["save_every"] < self.settings["evaluate_every"]:
                save(self.model, self.run, self.settings, self.clocks())
        return self.wall_s() < self.max_s

    def wall_s(self):
        return time.monotonic() - self.start

    def clocks(self):
        return {"wall_s": self.wall_s(), "processor_s": self.processor_before_s + processor_s()}

    def evaluate(self):
        n = self.settings["evaluation_episodes"]
        hits = evaluate(self.model, self.env, n, self.settings["evaluation_seed"])
        self.evaluated_at = self.num_timesteps
        low, high = wilson(hits, n)
        done = [self.num_timesteps, self.model._n_updates, round(self.wall_s(), 1)]
        row = [*done, hits / n, round(low, 4), round(high, 4), round(self.clocks()["processor_s"], 1)]
        with open(self.run / "progress.csv", "a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(row)
        text = f"env steps {done[0]:>8}  updates {done[1]:>8}  {done[2] / 60:7.1f} min  success {hits / n:.3f}"
        print(f"{text}  ({hits} of {n})", file=sys.stderr)


def save(model, run, settings, clocks):
    """Saves everything that a resumed run needs; state.json comes last and names what it belongs to."""
    model.save(run / "model.new.zip")
    model.save_replay_buffer(run / "replay.new.pkl")
    for name in ("model.zip", "replay.pkl"):
        os.replace(run / name.replace(".", ".new.", 1), run / name)
    state = {"settings": settings, "env_steps": model.num_timesteps, **clocks}
    (run / "state.new.json").write_text(json.dumps(state, indent=2), encoding="utf-8")
    os.replace(run / "state.new.json", run / "state.json")


def resume(run):
    """The saved settings and state; lines of progress after the saved step are dropped, for they are made again."""
    try:
        state = json.loads((run / "state.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        sys.exit(f"bench_sb3: {run} holds no saved run to resume: start one without --resume")
    with open(run / "progress.csv", newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if int(row["env_steps"]) <= state["env_steps"]]
    write_progress(run, rows)
    return state


def write_progress(run, rows):
    with open(run / "progress.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows(rows)


def positive(text):
    """Parses a whole number above 0."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected at least 1, got {number}")
    return number


def parse():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--algorithm", choices=("tqc", "ddpg"), default="tqc", help="[default: tqc]")
    parser.add_argument("--env", default="FetchPush-v4", help="Gymnasium id [default: FetchPush-v4]")
    parser.add_argument("--seed", type=int, default=1, help="seed of training [default: 1]")
    parser.add_argument("--out", type=Path, metavar="DIRECTORY", help="directory of the run")
    parser.add_argument("--starts", action="store_true", help="count the goals achieved at the start, and train nothing")
    parser.add_argument("--resume", action="store_true", help="continue the run in DIRECTORY with its own settings")
    parser.add_argument("--max-hours", type=float, default=3.0, help="wall-clock limit of the run [default: 3]")
    parser.add_argument("--max-env-steps", type=positive, default=1_000_000, help="[default: 1000000]")
    parser.add_argument("--evaluate-every", type=positive, default=5000, metavar="N", help="env steps [default: 5000]")
    parser.add_argument("--evaluation-episodes", type=positive, default=100, metavar="N", help="[default: 100]")
    parser.add_argument(
        "--evaluation-seed", type=int, default=777_000, metavar="S", help="of the first [default: 777000]"
    )
    parser.add_argument("--save-every", type=positive, default=50_000, metavar="N", help="env steps [default: 50000]")
    parser.add_argument("--device", default="auto", help="torch device [default: auto]")
    arguments = parser.parse_args()
    if not (arguments.out or arguments.starts):
        parser.error("a run needs --out DIRECTORY")
    return arguments


def main():
    arguments, clocks = parse(), {"wall_s": 0.0}
    if arguments.starts:
        n = arguments.evaluation_episodes
        n_achieved = count_starts(make_env(arguments.env), n, arguments.evaluation_seed)
        print(f"{arguments.env}: {n_achieved} of {n} evaluation goals are achieved at the start")
        return
    run = arguments.out
    if arguments.resume:
        state = resume(run)
        settings, clocks = state["settings"], state
    else:
        if (run / "state.json").exists():
            sys.exit(f"bench_sb3: {run} holds a run already: choose another directory, or give --resume")
        progress = run / "progress.csv"
        if progress.exists() and len(progress.read_text(encoding="utf-8").splitlines()) > 1:
            sys.exit(f"bench_sb3: {progress} is of a run that was never saved: delete it, or choose another directory")
        names = "algorithm env seed evaluate_every evaluation_episodes evaluation_seed save_every"
        settings = {name: getattr(arguments, name) for name in names.split()}
    env, evaluation_env = make_env(settings["env"]), make_env(settings["env"])
    if not arguments.resume:
        run.mkdir(parents=True, exist_ok=True)
        write_progress(run, [])
    if arguments.resume:
        kind = {"tqc": TQC, "ddpg": DDPG}[settings["algorithm"]]
        model = kind.load(run / "model.zip", env=env, device=arguments.device)
        model.load_replay_buffer(run / "replay.pkl")
    else:
        model = make_model(settings["algorithm"], env, settings["env"], settings["seed"], arguments.device)
    benchmark = Benchmark(run, settings, evaluation_env, clocks, arguments.max_hours)
    remaining = arguments.max_env_steps - model.num_timesteps
    if remaining > 0 and clocks["wall_s"] < 3600 * arguments.max_hours:
        try:
            model.learn(remaining, callback=benchmark, reset_num_timesteps=not arguments.resume)
        except KeyboardInterrupt:
            print("interrupted: saving", file=sys.stderr)
        else:
            if benchmark.evaluated_at != model.num_timesteps:
                benchmark.evaluate()
        save(model, run, settings, benchmark.clocks())
    print(run / "progress.csv")


if __name__ == "__main__":
    main()
