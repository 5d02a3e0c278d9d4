#!/usr/bin/env python3
"""Runs the public benchmarks of docs/benchmarks.md in pieces that can be interrupted and resumed.

A piece is one training run: Tandem or Stable-Baselines3, one environment, one seed. Its directory in --runs has the
run and processor.csv: the processor seconds of the run's processes at each evaluation. `collect` copies the small
files of all pieces to docs/results/benchmarks.
"""

import argparse
import contextlib
import csv
import dataclasses
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results" / "benchmarks"
EXAMPLES = """examples:
  python scripts/benchmarks.py list
  python scripts/benchmarks.py run tandem-fetch-push-1 tqc-fetch-push-1 --max-minutes 180
  python scripts/benchmarks.py run 'two-fetch-push-*-1'          needs teacher-fetch-push-1: its policy is the teacher
  python scripts/benchmarks.py run --group fetch-push            resumes what was interrupted, skips what is complete
  python scripts/benchmarks.py composed --task push
  python scripts/benchmarks.py collect
  python scripts/plot_benchmarks.py docs/results/benchmarks/*

Needs: pip install './python[grpc,fetch,panda]' and, for tqc and ddpg, scripts/requirements-benchmarks.txt
Ctrl-C ends a piece at its next checkpoint; the same command resumes it.
"""
SEEDS = (1, 2, 3)
ENVIRONMENTS = {
    "fetch-push": "FetchPush-v4",
    "fetch-pick-and-place": "FetchPickAndPlace-v4",
    "panda-push": "PandaPush-v3",
    "tandem-push": "tandem/Push-v0",
}
TWO_FETCH = {"push": "tandem/TwoFetchPush-v0", "pick-and-place": "tandem/TwoFetchPickAndPlace-v0"}
STRATEGIES = {"none": "none", "mc-q": "mc-q:0.1", "init-teacher": "init:teacher"}
SAMPLE_S = 1.0


@dataclasses.dataclass(frozen=True)
class Piece:
    """A training run."""

    name: str
    group: str
    kind: str
    env: str
    seed: int
    strategy: str | None = None
    teacher: str | None = None
    reports_contacts: bool = False


def pieces():
    """All pieces, by name."""
    found = []
    for group, env in ENVIRONMENTS.items():
        for kind in ("tandem", "tqc", "ddpg"):
            found += [Piece(f"{kind}-{group}-{seed}", group, kind, env, seed) for seed in SEEDS]
    for task, env in TWO_FETCH.items():
        group, one_arm = f"two-fetch-{task}", ENVIRONMENTS[f"fetch-{task}"]
        # A teacher's environment must report contacts as the student's does; one arm has none.
        found.append(Piece(teacher_name(task), group, "tandem", one_arm, 1, reports_contacts=True))
        for label, strategy in STRATEGIES.items():
            for seed in SEEDS:
                teacher = None if strategy == "none" else teacher_name(task)
                found.append(Piece(f"{group}-{label}-{seed}", group, "tandem", env, seed, strategy, teacher, True))
    return {piece.name: piece for piece in found}


def teacher_name(task):
    """The piece whose policy is the one-arm teacher of the two-arm task."""
    return f"teacher-fetch-{task}-1"


class Wrong(Exception):
    """An error that is reported in one line."""


class ProcessorMeter:
    """Processor seconds of a process and everything it started, also of processes that have ended since."""

    def __init__(self, pid):
        self._pid = pid
        self._seconds = {}
        self._tick_s = 1 / os.sysconf("SC_CLK_TCK")

    def sample(self):
        """Reads /proc and returns the processor seconds so far. Time after the last sample of a process is missed."""
        stats = {}
        for entry in os.listdir("/proc"):
            if entry.isdigit():
                with contextlib.suppress(OSError, ValueError, IndexError):
                    fields = Path("/proc", entry, "stat").read_text().rpartition(")")[2].split()
                    # Fields 4 (parent), 22 (start), 14 and 15 (user and system ticks) of proc(5).
                    stats[int(entry)] = (int(fields[1]), fields[19], (int(fields[11]) + int(fields[12])) * self._tick_s)
        own = {pid for pid, (_, start, _) in stats.items() if (pid, start) in self._seconds} | {self._pid}
        while more := {pid for pid, (parent, _, _) in stats.items() if parent in own} - own:
            own |= more
        for pid in own & stats.keys():
            _, start, seconds = stats[pid]
            self._seconds[pid, start] = seconds
        return sum(self._seconds.values())


def follow(run, process, before_s, ended):
    """Writes a line of processor.csv for each new evaluation in metrics.jsonl."""
    meter, metrics, file = ProcessorMeter(process.pid), run / "metrics.jsonl", run / "processor.csv"
    while True:
        is_over = ended.wait(SAMPLE_S)
        spent = before_s + meter.sample()
        with contextlib.suppress(OSError):
            done = [json.loads(line)["env_steps"] for line in complete_lines(metrics)]
            known = {int(row["env_steps"]) for row in rows_of(file)}
            new = [env_steps for env_steps in done if env_steps not in known]
            header = "" if file.exists() else "env_steps,processor_s\n"
            if new:
                with open(file, "a", encoding="utf-8") as lines:
                    lines.writelines([header, *(f"{env_steps},{spent:.1f}\n" for env_steps in new)])
        written = run / "processor_s.new"
        written.write_text(f"{spent:.1f}\n", encoding="utf-8")
        written.replace(run / "processor_s")
        if is_over:
            return


def complete_lines(path):
    return [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True) if line.endswith("\n")]


def rows_of(path):
    if not path.exists():
        return []
    with open(path, newline="", encoding="utf-8") as lines:
        return list(csv.DictReader(lines))


def program(options):
    """The `tandem` program."""
    if shutil.which(options.tandem) is None:
        raise Wrong(f"there is no program {options.tandem}: cargo build --release, then --tandem target/release/tandem")
    return options.tandem


def serve_command(env, *, reports_contacts):
    """The command that serves an environment to Tandem."""
    command = [sys.executable, "-m", "tandem.serve", env]
    if env.startswith("Fetch"):
        command += ["--reflection", "fetch"]
    if reports_contacts:
        command.append("--reports-contacts")
    return shlex.join(command)


def tandem_command(piece, run, options):
    resume = run.exists()
    command = [program(options), "train", "--out", str(run), "--json", "--max-env-steps", str(options.max_env_steps)]
    command += ["--max-minutes", str(options.max_minutes)]
    if options.workers:
        command += ["--workers", str(options.workers)]
    is_built_in = piece.env == "tandem/Push-v0"
    if not is_built_in:
        command += ["--env-command", serve_command(piece.env, reports_contacts=piece.reports_contacts)]
    if resume:
        return [*command, "--resume"]
    command += ["--seed", str(piece.seed)]
    if is_built_in:
        command += ["--task", "push", "--world", "classic", "--arms", "1"]
    if piece.strategy:
        command += ["--strategy", piece.strategy]
    if piece.teacher:
        command += ["--teacher", str(teacher_of(piece, options))]
    return command


def teacher_of(piece, options):
    policy = options.runs / piece.teacher / "policy" / "best.safetensors"
    if not policy.exists():
        raise Wrong(f"{piece.name} needs the policy of {piece.teacher}: run that piece first")
    return policy


def run_tandem(piece, run, options):
    """Trains with `tandem train`, and returns whether the run is complete."""
    command = tandem_command(piece, run, options)
    counted = run / "processor_s"
    before_s = float(counted.read_text(encoding="utf-8")) if counted.exists() else 0.0
    print(shlex.join(command), file=sys.stderr)
    # A process group of its own: Ctrl-C reaches this program only, which then asks Tandem to save and end.
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    ended = threading.Event()
    meter = threading.Thread(target=follow, args=(run, process, before_s, ended))
    try:
        while process.poll() is None and not run.exists():
            time.sleep(0.1)
        if run.exists():
            meter.start()
        output, _ = process.communicate()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate()
        raise
    finally:
        ended.set()
        if meter.ident:
            meter.join()
    if process.returncode != 0:
        raise Wrong(f"{piece.name}: tandem train ended with exit code {process.returncode}")
    (run / "summary.json").write_text(output.strip().splitlines()[-1] + "\n", encoding="utf-8")
    return True


def run_sb3(piece, run, options):
    """Trains with scripts/bench_sb3.py."""
    command = [sys.executable, str(ROOT / "scripts" / "bench_sb3.py"), "--out", str(run)]
    command += ["--max-hours", str(options.max_minutes / 60), "--max-env-steps", str(options.max_env_steps)]
    if (run / "state.json").exists():
        command.append("--resume")
    else:
        shutil.rmtree(run, ignore_errors=True)
        command += ["--algorithm", piece.kind, "--env", piece.env, "--seed", str(piece.seed)]
    print(shlex.join(command), file=sys.stderr)
    # As in run_tandem. Saving a replay buffer takes seconds.
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)
        process.wait()
        raise
    if process.returncode != 0:
        raise Wrong(f"{piece.name}: bench_sb3.py failed")
    state = json.loads((run / "state.json").read_text(encoding="utf-8"))
    limit_s = 60 * options.max_minutes
    if state["env_steps"] < options.max_env_steps and state["wall_s"] < limit_s:
        return False
    (run / "summary.json").write_text(json.dumps(state) + "\n", encoding="utf-8")
    return True


def run(options):
    chosen = select(options)
    for piece in chosen:
        directory = options.runs / piece.name
        if (directory / "summary.json").exists():
            print(f"{piece.name}: complete", file=sys.stderr)
            continue
        directory.parent.mkdir(parents=True, exist_ok=True)
        train = run_tandem if piece.kind == "tandem" else run_sb3
        state = "complete" if train(piece, directory, options) else "interrupted: run it again to resume"
        print(f"{piece.name}: {state}", file=sys.stderr)


def select(options):
    import fnmatch

    known = pieces()
    names = [name for pattern in options.names for name in fnmatch.filter(known, pattern)]
    unknown = [pattern for pattern in options.names if not fnmatch.filter(known, pattern)]
    names += [name for name, piece in known.items() if piece.group in options.group]
    if unknown or not names:
        asked = f"no piece is called {', '.join(unknown)}" if unknown else "no piece is given"
        raise Wrong(f"{asked}: python scripts/benchmarks.py list shows them")
    return [known[name] for name in dict.fromkeys(names)]


def show(options):
    for name, piece in pieces().items():
        directory = options.runs / name
        state = "complete" if (directory / "summary.json").exists() else "started" if directory.exists() else "-"
        print(f"{name:34} {piece.group:24} {piece.env:34} {state}")


def composed(options):
    """Evaluates the one-arm teacher driving each arm of the two-arm environment, without a student."""
    teacher = options.runs / teacher_name(options.task) / "policy" / "best.safetensors"
    policy = options.policy or teacher
    if not policy.exists():
        raise Wrong(f"there is no policy {policy}: run {teacher_name(options.task)}, or give --policy")
    serve = serve_command(TWO_FETCH[options.task], reports_contacts=True)
    command = [program(options), "eval", "--composed-teachers", str(policy), "--env-command", serve, "--json"]
    command += ["--episodes", str(options.episodes), "--seed", str(options.seed)]
    print(shlex.join(command), file=sys.stderr)
    evaluation = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if evaluation.returncode != 0:
        raise Wrong(f"tandem eval ended with exit code {evaluation.returncode}")
    result = evaluation.stdout.strip().splitlines()[-1]
    directory = options.runs / f"composed-fetch-{options.task}"
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "summary.json").write_text(result + "\n", encoding="utf-8")
    print(result)


def collect(options):
    """Copies the small files of all pieces, without the paths of this machine."""
    if not options.runs.is_dir():
        sys.exit(f"benchmarks: no pieces in {options.runs}")
    small = ("metrics.jsonl", "run.toml", "summary.json", "processor.csv", "progress.csv")
    for directory in sorted(options.runs.iterdir()):
        files = [directory / name for name in small if (directory / name).is_file()]
        if not files:
            continue
        target = RESULTS / directory.name
        target.mkdir(parents=True, exist_ok=True)
        for file in files:
            shutil.copy(file, target / file.name)
            if file.suffix in (".jsonl", ".csv"):
                # A run that is being written may end within a line.
                (target / file.name).write_text("".join(complete_lines(file)), encoding="utf-8")
        summary = target / "summary.json"
        if summary.is_file():
            content = json.loads(summary.read_text(encoding="utf-8"))
            kept = {key: value for key, value in content.items() if key not in ("run_dir", "policy")}
            summary.write_text(json.dumps(kept) + "\n", encoding="utf-8")
        print(target.relative_to(ROOT))


def parse():
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=Path, default=Path("runs/benchmarks"), help="[default: runs/benchmarks]")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    commands.add_parser("list", help="lists the pieces and how far they are").set_defaults(command=show)
    training = commands.add_parser("run", help="runs or resumes pieces, one after the other")
    training.set_defaults(command=run)
    training.add_argument("names", nargs="*", metavar="NAME", help="names of pieces; * matches any characters")
    groups = sorted({piece.group for piece in pieces().values()})
    of_group = {"action": "append", "default": [], "choices": groups, "metavar": "GROUP"}
    training.add_argument("--group", **of_group, help="all pieces of a group; can be repeated")
    training.add_argument("--max-minutes", type=float, default=180, help="wall-clock limit of a piece [default: 180]")
    training.add_argument("--max-env-steps", type=int, default=1_000_000, help="[default: 1000000]")
    training.add_argument("--workers", type=int, help="worker processes of Tandem [default: one per core]")
    training.add_argument("--tandem", default="tandem", help="the program [default: tandem]")
    teachers = commands.add_parser("composed", help="evaluates the one-arm teacher driving each of two arms")
    teachers.set_defaults(command=composed)
    teachers.add_argument("--task", choices=tuple(TWO_FETCH), default="push", help="[default: push]")
    teachers.add_argument("--policy", type=Path, metavar="FILE", help="one-arm policy [that of teacher-fetch-TASK-1]")
    teachers.add_argument("--episodes", type=int, default=240, help="[default: 240]")
    teachers.add_argument("--seed", type=int, default=777, help="of the test goals [default: 777]")
    teachers.add_argument("--tandem", default="tandem", help="the program [default: tandem]")
    commands.add_parser("collect", help=f"copies results to {RESULTS.relative_to(ROOT)}").set_defaults(command=collect)
    return parser.parse_args()


def main():
    options = parse()
    options.command(options)


if __name__ == "__main__":
    try:
        main()
    except Wrong as error:
        sys.exit(f"benchmarks: {error}")
    except KeyboardInterrupt:
        sys.exit("benchmarks: interrupted: run the same command again to resume")
