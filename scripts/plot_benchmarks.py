#!/usr/bin/env python3
"""Compares training runs of Tandem and of scripts/bench_sb3.py: a table, and optionally curves.

A run is a directory with metrics.jsonl (Tandem) or progress.csv (bench_sb3.py), or such a file; metrics.csv with the
columns env_steps, wall_s and success is read as well. The table has, for each run, the env steps and minutes after
which an evaluation first reached a success rate, and the last evaluation.
"""

import argparse
import csv
import json
import sys
from pathlib import Path

NAMES = ("metrics.jsonl", "metrics.csv", "progress.csv")
RATES = (0.5, 0.9, 0.95)
EXAMPLES = """examples:
  python scripts/plot_benchmarks.py runs/fetch-push-1 runs/sb3/tqc-push-1
  python scripts/plot_benchmarks.py runs/* --x minutes --out curves.svg
  python scripts/plot_benchmarks.py docs/results/from-scratch/push-none-seed1 --json
"""


class Wrong(Exception):
    """An error that is reported in one line."""


def read(path):
    """The evaluations of a run, in order: dictionaries with env_steps, wall_s, updates and success."""
    if path.is_dir():
        file = next((path / name for name in NAMES if (path / name).is_file()), None)
        if file is None:
            raise Wrong(f"{path} has none of {', '.join(NAMES)}")
    else:
        file = path
    try:
        with open(file, newline="", encoding="utf-8") as lines:
            rows = [json.loads(line) for line in lines] if file.suffix == ".jsonl" else list(csv.DictReader(lines))
        keys = ("env_steps", "updates", "wall_s", "success")
        rows = [row for row in rows if row.get("success") not in (None, "")]
        return [{key: float(row[key]) for key in keys if row.get(key) not in (None, "")} for row in rows]
    except (OSError, ValueError, KeyError) as error:
        raise Wrong(f"cannot read {file}: {error}") from None


def measures(path, evaluations):
    """What the table shows of a run; None where a rate was not reached."""
    reached = {}
    for rate in RATES:
        first = next((row for row in evaluations if row["success"] >= rate), None)
        reached[f"{rate:g}"] = first and {"env_steps": int(first["env_steps"]), "minutes": first["wall_s"] / 60}
    last = evaluations[-1]
    return {
        "run": str(path),
        "evaluations": len(evaluations),
        "env_steps": int(last["env_steps"]),
        "minutes": last["wall_s"] / 60,
        "success": last["success"],
        "best_success": max(row["success"] for row in evaluations),
        "reached": reached,
    }


def print_table(results):
    print("| run | env steps | minutes | last | best | " + " | ".join(f"to {rate:.0%}" for rate in RATES) + " |")
    print("|---" * (5 + len(RATES)) + "|")
    for result in results:
        cells = [result["run"], f"{result['env_steps']}", f"{result['minutes']:.1f}"]
        cells += [f"{result['success']:.3f}", f"{result['best_success']:.3f}"]
        cells += [
            f"{first['env_steps']} ({first['minutes']:.1f} min)" if first else "–"
            for first in result["reached"].values()
        ]
        print("| " + " | ".join(cells) + " |")


def plot(runs, x, out):
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError:
        raise Wrong("--out needs matplotlib: pip install matplotlib") from None
    figure, axes = pyplot.subplots(figsize=(8, 4.5), layout="constrained")
    for path, evaluations in runs:
        at = [row["env_steps"] if x == "env-steps" else row["wall_s"] / 60 for row in evaluations]
        axes.plot(at, [row["success"] for row in evaluations], label=path.name)
    axes.set(xlabel="environment steps" if x == "env-steps" else "minutes", ylabel="success", ylim=(0.0, 1.02))
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(out)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="directories or files of runs")
    parser.add_argument("--x", choices=("env-steps", "minutes"), default="env-steps", help="[default: env-steps]")
    parser.add_argument("--out", type=Path, metavar="FILE.svg", help="also draw the curves (needs matplotlib)")
    parser.add_argument("--json", action="store_true", help="print one JSON array instead of a table")
    arguments = parser.parse_args()
    runs = [(path, read(path)) for path in arguments.runs]
    empty = [str(path) for path, evaluations in runs if not evaluations]
    if empty:
        raise Wrong(f"no evaluations in {', '.join(empty)}")
    results = [measures(path, evaluations) for path, evaluations in runs]
    if arguments.out:
        plot(runs, arguments.x, arguments.out)
    print(json.dumps(results)) if arguments.json else print_table(results)


if __name__ == "__main__":
    try:
        main()
    except Wrong as error:
        sys.exit(f"plot_benchmarks: {error}")
