"""Stands in for `tandem` while the guide is tested: shortens what takes long, then becomes the program.

The rules, by subcommand; everything else runs as it is:

    train         800 environment steps with small networks and few evaluation goals; a resumed run has 1,600
    learner       the same, in a copy of its run file
    sweep         the file as it is with --dry-run; then its first task, column, seed and values, with runs of 800 steps;
                  another seed beside finished runs that were not shortened, which would be refused
    eval          at most 8 episodes; films of 160x100 pixels
    replay        an evaluation that the shortened run did not reach is replaced by its last one
    bench         the replay buffer only; `scale` with 20 idle workers and one round
    bridge        with real-time priority, if that is permitted; `move` at full speed, `trial` with one trial

`GUIDE_PROGRAM` is the program.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ENV_STEPS, RESUMED_ENV_STEPS = 800, 1600
MAX_EPISODES = 8
EVALUATION = {"episodes": 8, "every_env_steps": 800, "early_points": 0, "test_episodes": 8}


def main(arguments: list[str]) -> None:
    program = os.environ["GUIDE_PROGRAM"]
    shorten = RULES.get(arguments[0] if arguments else "")
    if shorten and not {"--help", "--settings", "--print-run"} & set(arguments):
        arguments = shorten(arguments)
    print("as run: tandem", *arguments, file=open(os.environ["GUIDE_LOG"], "a"))
    os.execv(program, [program, *arguments])


def train(arguments: list[str]) -> list[str]:
    resumes = "--resume" in arguments
    arguments = without(arguments, "--max-env-steps", "--max-minutes", "--until-success", "--workers")
    arguments += ["--workers", "2", "--max-env-steps", str(RESUMED_ENV_STEPS if resumes else ENV_STEPS)]
    if resumes:
        return arguments
    # A student that starts as copies of its teacher has the teacher's networks.
    hidden = [] if value(arguments, "--strategy") == "init:teacher" else ["ddpg.n_hidden=16"]
    settings = [f"evaluation.{name}={number}" for name, number in EVALUATION.items()] + hidden
    return arguments + [word for setting in settings for word in ("--set", setting)]


def learner(arguments: list[str]) -> list[str]:
    run = tomllib.loads(Path(value(arguments, "--run")).read_text())
    file = Path(tempfile.mkdtemp(), "run.toml")
    file.write_text(to_toml(short_run(run)))
    return without(arguments, "--run") + ["--run", str(file)]


def sweep(arguments: list[str]) -> list[str]:
    if "--dry-run" in arguments:
        return arguments
    path = Path(next(word for word in arguments if word.endswith(".toml")))
    subprocess.run([os.environ["GUIDE_PROGRAM"], *arguments, "--dry-run"], check=True, stdout=subprocess.DEVNULL)
    sweep = tomllib.loads(path.read_text())
    for key in ("tasks", "seeds", "variant"):
        if key in sweep:
            sweep[key] = sweep[key][:1]
    # Teachers and settings of a task that is left out are refused.
    for key in {"teachers", "per_task"} & sweep.keys():
        sweep[key] = {task: of_task for task, of_task in sweep[key].items() if task in sweep.get("tasks", [task])}
    for settings in sweep.get("per_task", {}).values():
        settings.pop("stop", None)
    if "strategies" in sweep:
        sweep["strategies"] = sweep["strategies"][-1:]
    for axis in sweep.get("axis", []):
        axis.update({key: values[:1] for key, values in axis.items()})
    finished = Path(value(arguments, "--out") or f"runs/{path.stem}").glob("*/summary.json")
    if any(json.loads(file.read_text())["env_steps"] > ENV_STEPS for file in finished):
        sweep["seeds"] = [1001]
    sweep["run"] = short_run(sweep.get("run", {}))
    file = Path(tempfile.mkdtemp(), path.name)
    file.write_text(to_toml(sweep))
    return [str(file) if word == str(path) else word for word in arguments]


def evaluate(arguments: list[str]) -> list[str]:
    episodes = int(value(arguments, "--episodes") or MAX_EPISODES)
    small = ["--film-size", "160x100"] if "--film" in arguments else []
    return without(arguments, "--episodes", "--film-size") + ["--episodes", str(min(episodes, MAX_EPISODES)), *small]


def replay(arguments: list[str]) -> list[str]:
    def last(word: str) -> str:
        path = Path(word)
        if path.name.startswith("eval-") and not path.exists():
            logs = sorted(path.parent.glob("eval-*-000.mcap"))
            return str(logs[-1]) if logs else word
        return word

    small = ["--film-size", "160x100"] if "--film" in arguments else []
    return [last(word) for word in without(arguments, "--film-size")] + small


def bench(arguments: list[str]) -> list[str]:
    if "scale" in arguments:
        arguments = without(arguments, "--workers", "--idle", "--rounds", "--join-leave", "--relays", "--slot-s")
        return arguments + ["--workers", "0", "--idle", "20", "--rounds", "1", "--slot-s", "0.2"]
    return ["bench", "replay"]


def bridge(arguments: list[str]) -> list[str]:
    match arguments[1:2]:
        case ["move"] if "--check-only" not in arguments:
            return without(arguments, "--speed") + ["--speed", "1"]
        case ["trial"]:
            return without(arguments, "--trials") + ["--trials", "1"]
        case [first, *_] if not first.startswith("--"):
            return arguments
        case _:
            # Late ticks stop the arms, and a machine that runs tests is late.
            with contextlib.suppress(PermissionError):
                os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(5))
            return arguments


RULES = {
    "train": train,
    "learner": learner,
    "sweep": sweep,
    "eval": evaluate,
    "replay": replay,
    "bench": bench,
    "bridge": bridge,
}


def short_run(run: dict) -> dict:
    """Returns a run file's settings with a small run in them."""
    run = {key: dict(held) if isinstance(held, dict) else held for key, held in run.items()}
    run["stop"] = {"max_env_steps": ENV_STEPS}
    run["evaluation"] = {**run.get("evaluation", {}), **EVALUATION}
    run["ddpg"] = {**run.get("ddpg", {}), "n_hidden": 16}
    return run


def value(arguments: list[str], option: str) -> str | None:
    for word, following in zip(arguments, arguments[1:] + [""]):
        if word == option:
            return following
        if word.startswith(option + "="):
            return word.removeprefix(option + "=")
    return None


def without(arguments: list[str], *options: str) -> list[str]:
    """Returns the arguments without these options and their values."""
    kept, skip = [], False
    for word in arguments:
        if skip:
            skip = False
        elif word in options:
            skip = True
        elif not word.startswith(tuple(f"{option}=" for option in options)):
            kept.append(word)
    return kept


def to_toml(table: dict) -> str:
    return "".join(f"{json.dumps(key)} = {inline(held)}\n" for key, held in table.items())


def inline(held: object) -> str:
    match held:
        case dict():
            return "{ " + ", ".join(f"{json.dumps(key)} = {inline(inner)}" for key, inner in held.items()) + " }"
        case list():
            return "[" + ", ".join(map(inline, held)) + "]"
        case _:
            return json.dumps(held)


if __name__ == "__main__":
    main(sys.argv[1:])
