#!/usr/bin/env python3
"""Compares training runs of Tandem and of scripts/bench_sb3.py: a table, and optionally curves.

A run is a directory with metrics.jsonl (Tandem) or progress.csv (bench_sb3.py), or such a file; metrics.csv with the
columns env_steps, wall_s and success is read as well. Processor seconds of Tandem are in processor.csv beside it, which
scripts/benchmarks.py writes. The table has, for each run, the env steps, updates, minutes and processor seconds after
which an evaluation first reached a success rate, the last evaluation and, if summary.json is beside it, the best policy
on test goals, both with their 95 % intervals. Directories of another kind, such as those of composed teachers, are left
out.
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
  python scripts/plot_benchmarks.py docs/results/benchmarks/*
  python scripts/plot_benchmarks.py docs/results/from-scratch-classic/push-none-seed1 --json
"""


class Wrong(Exception):
    """An error that is reported in one line."""


INTERVAL = ("success", "success_low", "success_high")
KEYS = ("env_steps", "updates", "wall_s", *INTERVAL, "processor_s")


def file_of(path):
    """The file with a run's evaluations; None if the directory holds something else."""
    if not path.is_dir():
        return path
    return next((path / name for name in NAMES if (path / name).is_file()), None)


def read(file):
    """The evaluations of a run, in order: dictionaries with those of KEYS that the file has."""
    try:
        rows = [row for row in rows_of(file) if row.get("success") not in (None, "")]
        for row in rows:
            if missing := {"env_steps", "wall_s"} - row.keys():
                raise Wrong(f"cannot read {file}: it has no {' and no '.join(sorted(missing))}")
        runs = [{key: float(row[key]) for key in KEYS if row.get(key) not in (None, "")} for row in rows]
        processor = file.parent / "processor.csv"
        if processor.is_file():
            spent = {int(row["env_steps"]): float(row["processor_s"]) for row in rows_of(processor)}
            for row in runs:
                if int(row["env_steps"]) in spent:
                    row["processor_s"] = spent[int(row["env_steps"])]
        return runs
    except (OSError, ValueError, KeyError) as error:
        raise Wrong(f"cannot read {file}: {error}") from None


def rows_of(file):
    with open(file, newline="", encoding="utf-8") as lines:
        # A run that is being written, or was killed, may end within a line.
        complete = [line for line in lines if line.endswith("\n")]
    return [json.loads(line) for line in complete] if file.suffix == ".jsonl" else list(csv.DictReader(complete))


def test_of(file):
    """Success of the run's best policy on test goals, with its interval; None if it is not recorded."""
    summary = file.parent / "summary.json"
    if not summary.is_file():
        return None
    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
        return {key: float(content[key]) for key in INTERVAL} if "success" in content else None
    except (OSError, ValueError, KeyError) as error:
        raise Wrong(f"cannot read {summary}: {error}") from None


def cost(row):
    """What a run had spent at an evaluation; None for what is not recorded."""
    updates, processor_s = row.get("updates"), row.get("processor_s")
    return {
        "env_steps": int(row["env_steps"]),
        "updates": None if updates is None else int(updates),
        "minutes": row["wall_s"] / 60,
        "processor_s": processor_s,
    }


def measures(path, evaluations, test):
    """What the table shows of a run; None where a rate was not reached."""
    reached = {}
    for rate in RATES:
        first = next((row for row in evaluations if row["success"] >= rate), None)
        reached[f"{rate:g}"] = first and cost(first)
    last = evaluations[-1]
    return {
        "run": str(path),
        "evaluations": len(evaluations),
        **cost(last),
        **{key: last.get(key) for key in INTERVAL},
        "test": test,
        "best_success": max(row["success"] for row in evaluations),
        "reached": reached,
    }


def text_of(spent):
    """Env steps, updates, minutes and processor seconds, in one cell of the table."""
    if spent is None:
        return "–"
    updates, processor_s = spent["updates"], spent["processor_s"]
    cells = [f"{spent['env_steps']:,}", "–" if updates is None else f"{updates:,}", f"{spent['minutes']:.1f}"]
    return " / ".join([*cells, "–" if processor_s is None else f"{processor_s:,.0f}"])


def success_text(values):
    """Success with its interval, in one cell of the table."""
    if values is None:
        return "–"
    low, high = values["success_low"], values["success_high"]
    interval = "" if low is None or high is None else f" [{low:.3f}, {high:.3f}]"
    return f"{values['success']:.3f}{interval}"


def print_table(results):
    print("Each cell: env steps / updates / minutes / processor seconds.\n")
    heads = [f"to {rate:.0%}" for rate in RATES]
    print("| run | in all | " + " | ".join(heads) + " | last evaluation | best | test goals |")
    print("|---" * (5 + len(RATES)) + "|")
    for result in results:
        cells = [Path(result["run"]).name, text_of(result), *map(text_of, result["reached"].values())]
        cells += [success_text(result), f"{result['best_success']:.3f}", success_text(result["test"])]
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
    files = [(path, file_of(path)) for path in arguments.runs]
    runs = [(path, read(file)) for path, file in files if file is not None]
    if not runs:
        raise Wrong(f"no run has {', '.join(NAMES)}")
    empty = [str(path) for path, evaluations in runs if not evaluations]
    runs = [(path, evaluations) for path, evaluations in runs if evaluations]
    if empty:
        message = f"no evaluations in {', '.join(empty)}"
        if not runs:
            raise Wrong(message)
        print(f"plot_benchmarks: {message}: left out", file=sys.stderr)
    results = [measures(path, evaluations, test_of(file_of(path))) for path, evaluations in runs]
    if arguments.out:
        plot(runs, arguments.x, arguments.out)
    print(json.dumps(results)) if arguments.json else print_table(results)


if __name__ == "__main__":
    try:
        main()
    except Wrong as error:
        sys.exit(f"plot_benchmarks: {error}")
