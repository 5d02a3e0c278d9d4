"""Recorded episodes as NumPy arrays."""

from __future__ import annotations

import dataclasses
import json
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tandem import _native
from tandem.envs import env_id_of

_Floats = NDArray[np.float32]
_Bools = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Episode:
    """An episode from a log: arrays of its steps, and where it comes from.

    `T` is the number of steps. Row `t` of `action`, `reward` and the other arrays of `T` rows belongs to step `t`,
    which leads from row `t` of `observation` to row `t + 1`. In the built-in tasks the vectors of several arms are
    concatenated in arm order, each in the frame of its arm: origin on the table, x away from the arm's base, z up.
    Lengths are metres and rates are per control step; docs/teacher.md lists all numbers. Other tasks have the vectors
    of their environments.

    Episodes never terminate; they end at the time limit of their task.
    """

    path: Path
    """The log."""

    observation: _Floats
    """Shape `[T + 1, n_observation]`."""
    achieved_goal: _Floats
    """Shape `[T + 1, n_goal]`."""
    desired_goal: _Floats
    """Shape `[n_goal]`."""
    action: _Floats
    """The executed actions, in [-1, 1], shape `[T, n_action]`: the teacher's for overridden arms, otherwise the
    student's, in training with exploration."""
    reward: _Floats
    """The joint reward of all arms as logged, shape `[T]`: 0 if the distance between `achieved_goal[t + 1]` and
    `desired_goal` is within the tolerance of the task, else -1."""
    reward_per_arm: _Floats
    """The same of each arm's part of the goal, shape `[T, n_arms]`."""

    asked: _Bools
    """Whether the log has advice of the teacher on the step, shape `[T]`."""
    overridden: _Bools
    """Whether the arm executed the teacher's action, shape `[T, n_arms]`."""
    teacher_action: _Floats
    """The teacher's actions, shape `[T, n_action]`; NaN where it was not asked."""
    q_teacher: _Floats
    """The teacher's value of its own action for each arm, shape `[T, n_arms]`; NaN where it was not asked."""
    q_student: _Floats
    """The teacher's value of the student's action that it judged, shape `[T, n_arms]`; NaN where it was not asked."""
    importance: _Floats
    """The importance of advice, `q_teacher - q_student`, shape `[T, n_arms]`; NaN where the teacher was not asked."""
    distance: _Floats
    """The Euclidean distance of these two actions, shape `[T, n_arms]`; NaN where it was not asked."""
    budget_left: NDArray[np.int64]
    """Units of the advice budget that the run had left when the teacher answered, shape `[T]`; -1 where unknown."""

    arm_contact: _Bools
    """Whether two arms touched in the step, shape `[T]`."""
    table_contact: _Bools
    """Whether an arm touched the table in the step, shape `[T]`."""

    success: bool | None
    """Whether the episode succeeded as evaluations count it; None if the log ends before its episode."""
    success_per_arm: _Bools | None
    """The same of each arm, shape `[n_arms]`."""

    run: str
    """Name of the run."""
    number: int
    """Number of the episode: within the run in training, of the goal in an evaluation."""
    seed: int
    """The seed; with the number, it determines the start."""
    kind: Literal["training", "evaluation"]
    """Whether the episode was played with exploration and advice, or by the policy alone."""
    parameter_version: int
    """Version of the parameters that acted; each round of a run makes one."""
    policy_digest: str
    """Digest of the policy that acted."""
    task: str
    """Name of the task, such as `shared-push`."""
    n_arms: int
    """Number of arms."""
    description: dict[str, Any]
    """The description of the task, with the fields of `task.proto`: `tolerance`, `norm`, indices of the arms, etc."""
    world: dict[str, str]
    """Settings of the world as logged."""
    step_s: float | None
    """Duration of a control step in simulated time, seconds; None for a task that is not built-in."""
    env_id: str | None
    """Name of the environment with the task, for `gymnasium.make`; None if it is not of this package's simulator."""
    env_kwargs: dict[str, Any] | None
    """Arguments of `gymnasium.make` that give it the episode's world. After `reset(seed=episode.seed,
    options={"episode": episode.number})` it starts as the episode did, bit for bit. None for worlds that this package
    does not have: those of other tasks, and some of earlier versions."""

    @property
    def n_steps(self) -> int:
        """The number `T` of steps."""
        return len(self.action)

    @property
    def is_complete(self) -> bool:
        """Whether the log has the whole episode; the recovered log of a killed process may have only its start."""
        return self.success is not None

    def __repr__(self) -> str:
        names = ("task", "n_arms", "kind", "number", "seed", "parameter_version", "n_steps", "success")
        return f"Episode({', '.join(f'{name}={getattr(self, name)!r}' for name in names)})"


def read_episodes(path: str | os.PathLike[str]) -> Iterator[Episode]:
    """Returns an iterator over recorded episodes, which reads one log at a time.

    Args:
        path: A log, a directory, or a run directory. Of a directory, the logs in and below it are read in the order of
            their names. Logs of trials and of bridges in it are left out, with one warning at the end; so are files
            that are deleted meanwhile, as a run with a log budget does.

    Raises:
        FileNotFoundError: There is no such path, or no log below it.
        OSError: While iterating: a log cannot be read.
        ValueError: While iterating: a log is incomplete or damaged, or is no episode's. The iterator can be used after
            this error and continues with the next log.
    """
    path = Path(path)
    if not path.is_dir():
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist: name a log, a directory of logs or a run directory")
        return _Episodes([path], is_directory=False)
    with os.scandir(path):
        pass  # An unreadable directory is an error. Others below it are left out if they disappear.
    logs = list(_logs_below(path))
    if not logs:
        record = "record episodes by `tandem eval --record-dir DIR` or `tandem train --record all`"
        raise FileNotFoundError(f"no *.mcap below {path}: {record}")
    return _Episodes(logs, is_directory=True)


def _logs_below(directory: str | os.PathLike[str]) -> Iterator[Path]:
    """Returns the logs in and below a directory in the order of their names."""
    try:
        with os.scandir(directory) as entries:
            ordered = sorted(entries, key=lambda entry: entry.name)
    except FileNotFoundError:
        return
    for entry in ordered:
        if entry.is_dir(follow_symlinks=False):
            yield from _logs_below(entry.path)
        elif entry.name.endswith(".mcap"):
            yield Path(entry.path)


class _Episodes(Iterator[Episode]):
    """The episodes of some logs. Unlike a generator, it continues after an error."""

    def __init__(self, logs: list[Path], *, is_directory: bool) -> None:
        self._logs = iter(logs)
        self._is_directory = is_directory
        self._n_episodes = 0
        self._others: list[str] = []
        """Messages about logs that are no episode's."""

    def __next__(self) -> Episode:
        for path in self._logs:
            try:
                fields = _native.read_episode(path)
            except FileNotFoundError:
                if self._is_directory:
                    continue
                raise
            if isinstance(fields, dict):
                self._n_episodes += 1
                return _episode(path, fields)
            if not self._is_directory:
                raise ValueError(fields)
            self._others.append(fields)
        self._report_others()
        raise StopIteration

    def _report_others(self) -> None:
        others, self._others = self._others, []
        if not others:
            return
        logs = f"{len(others)} log{'s' if len(others) > 1 else ''} of trials or motions"
        if not self._n_episodes:
            raise ValueError(f"no log of an episode among {logs}, the first: {others[0]}")
        warnings.warn(f"{logs} left out, the first: {others[0]}", stacklevel=3)


def _episode(path: Path, fields: dict[str, Any]) -> Episode:
    fields["description"] = json.loads(fields["description"])
    return Episode(path=path, env_id=env_id_of(fields["task"], fields["n_arms"]), **fields)
