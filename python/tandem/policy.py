"""Policies from files: actions, values and conversion to PyTorch."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tandem import _native
from tandem.envs import env_id_of

if TYPE_CHECKING:
    from tandem.torch_policy import TorchPolicy

_Floats = NDArray[np.float32]

_BEST = "policy/best.safetensors"
"""The best policy of a run, in its directory."""


class Policy:
    """A trained policy: actor, critic and the normalisation of their inputs.

    Inputs are dictionaries as the environments return them, with arrays of shape `[n]` or `[batch, n]`. Outputs have
    the bits of the Rust implementation, and a row has the same bits in any batch. Any thread may call any method.
    Policies can be pickled and copied.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._native = _native.Policy(_file_of(path))

    @property
    def task(self) -> str:
        """Name of the task: a built-in one, such as `shared-push`, or one that was served, such as `fetchpush-v4`."""
        return self._native.task

    @property
    def n_arms(self) -> int:
        """Number of arms."""
        return self._native.n_arms

    @property
    def n_observation(self) -> int:
        """Length of an observation."""
        return self._native.n_observation

    @property
    def n_goal(self) -> int:
        """Length of a goal."""
        return self._native.n_goal

    @property
    def n_action(self) -> int:
        """Length of an action."""
        return self._native.n_action

    @property
    def env_id(self) -> str:
        """Name of the environment with the policy's task, for `gymnasium.make`.

        Raises:
            ValueError: The task is not of this package's simulator.
        """
        env_id = env_id_of(self.task, self.n_arms)
        if env_id is None:
            own = "create its environment by its own id and wrap it in tandem.ServedEnv"
            raise ValueError(f"task {self.task!r} is not of this package's simulator: {own}")
        return env_id

    @property
    def has_critic(self) -> bool:
        """Whether the policy has values; an actor that was imported without a critic has none."""
        return self._native.has_critic

    @property
    def metadata(self) -> dict[str, str]:
        """Entries of the file about training and success rates."""
        return self._native.metadata

    @property
    def digest(self) -> str:
        """SHA-256 of the tensors, hexadecimal; `tandem` names policies by it."""
        return self._native.digest

    def tensors(self) -> dict[str, _Floats]:
        """Returns copies of all tensors by their names in the file, which docs/policy-format.md specifies."""
        return self._native.tensors()

    def predict(
        self,
        observation: Mapping[str, ArrayLike],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[_Floats, None]:
        """Returns the actions, in [-1, 1], shape `[n_action]` or `[batch, n_action]`, and None.

        The signature is that of Stable-Baselines3. A policy has no state and is always deterministic.

        Args:
            observation: Arrays `observation` and `desired_goal`, shapes `[n]` or `[batch, n]`.
            state: Has no effect.
            episode_start: Has no effect.
            deterministic: Has no effect.

        Raises:
            TypeError: The observation is no mapping.
            KeyError: An array is missing.
            ValueError: An array has another shape or contains a number that is not finite.
        """
        observations, goals, is_batch = self._inputs(observation)
        actions = self._native.act(observations, goals)
        return (actions if is_batch else actions[0]), None

    def q(self, observation: Mapping[str, ArrayLike], action: ArrayLike) -> _Floats:
        """Returns the values of actions, shape `[n_heads]` or `[batch, n_heads]`.

        A value is the expected discounted return: one number per arm, of the arm's own rewards, or one for all arms.

        Args:
            observation: As for `predict`.
            action: Actions in [-1, 1], shape `[n_action]` or `[batch, n_action]`.

        Raises:
            TypeError: The observation is no mapping.
            KeyError: An array of the observation is missing.
            ValueError: The policy has no critic, or an array has another shape or contains a number that is not finite.
        """
        observations, goals, is_batch = self._inputs(observation)
        values = self._native.q(observations, goals, _rows(action))
        return values if is_batch else values[0]

    def to_torch(self) -> TorchPolicy:
        """Returns the policy as a PyTorch module with modules `actor` and `critic`.

        Raises:
            ImportError: PyTorch is not installed.
        """
        try:
            from tandem.torch_policy import TorchPolicy
        except ImportError as error:
            raise ImportError("to_torch needs PyTorch: pip install torch") from error
        return TorchPolicy(self)

    def _inputs(self, observation: Mapping[str, ArrayLike]) -> tuple[_Floats, _Floats, bool]:
        expected_keys = 'a mapping with "observation" and "desired_goal"'
        if not isinstance(observation, Mapping):
            raise TypeError(f"the observation is of type {type(observation).__name__}, expected {expected_keys}")
        for key in ("observation", "desired_goal"):
            if key not in observation:
                raise KeyError(f"the observation has no {key}, expected {expected_keys}")
        is_batch = np.ndim(observation["observation"]) > 1
        observations = _rows(observation["observation"])
        expected = (len(observations), self._native.n_observation)
        if observations.shape != expected and env_id_of(self.task, self.n_arms) is None:
            served = f"tandem.ServedEnv gives an environment the vectors that {self.task!r} had on its server"
            raise ValueError(f"observations have shape {observations.shape}, expected {expected}: {served}")
        return observations, _rows(observation["desired_goal"]), is_batch

    @property
    def _description(self) -> str | None:
        """The description of a task that is not built-in, as JSON."""
        file = self._native.to_bytes()
        length = int.from_bytes(file[:8], "little")
        description: str | None = json.loads(file[8 : 8 + length])["__metadata__"].get("description")
        return description

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_native": self._native.to_bytes()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _native=_native.Policy.from_bytes(state["_native"]))

    def __repr__(self) -> str:
        return f"Policy(task={self.task!r}, n_arms={self.n_arms}, digest={self.digest[:12]!r})"


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Loads a policy file, such as `policies/student-push.safetensors`, or the best policy of a run directory.

    Raises:
        OSError: The file does not exist or cannot be read, or the directory has no policy.
        ValueError: The file is no policy, is of another version, or was altered.
    """
    return Policy(path)


def _file_of(path: str | os.PathLike[str]) -> str:
    """Returns the policy file that `path` names: the file itself, or the best policy of a run directory."""
    file = os.fspath(path)
    if os.path.isdir(file):
        file = os.path.join(file, _BEST)
        if not os.path.exists(file):
            advice = "name a policy file, or the directory of a run that was evaluated"
            raise FileNotFoundError(f"{os.fspath(path)} is a directory without {_BEST}: {advice}")
    if not os.path.exists(file):
        raise FileNotFoundError(errno.ENOENT, "there is no policy file", file)
    if file.lower().endswith(".onnx"):
        command = f"tandem policy import {file} --out FILE.safetensors"
        raise ValueError(f"{file} is an ONNX model: convert it with `{command}`")
    return file


def _rows(array: ArrayLike) -> _Floats:
    """Returns an array of shape `[n]` or `[batch, n]` as `[batch, n]`."""
    rows = np.atleast_2d(np.asarray(array, dtype=np.float32))
    if rows.ndim > 2:
        raise ValueError(f"an array has {rows.ndim} dimensions, expected 1 or 2")
    return rows
