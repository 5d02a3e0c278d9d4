"""Policies: the numbers of the file format, success in the simulator, and refused files."""

import copy
import json
import os
import pickle
import shutil
import subprocess

import gymnasium
import numpy as np
import pytest
from conftest import POLICIES, ROOT

import tandem


def inputs(policy, rng, *shape):
    sizes = {"observation": policy.tensors()["normalizer.observation.mean"].size, "desired_goal": 3 * policy.n_arms}
    return {name: rng.uniform(-0.5, 0.5, (*shape, size)).astype(np.float32) for name, size in sizes.items()}


def network(tensors, name, rows):
    """The computation of docs/policy-format.md in double precision."""
    idx = 0
    while (weight := tensors.get(f"{name}.layers.{idx}.weight")) is not None:
        rows = np.maximum(rows, 0) if idx else rows
        rows = rows @ weight.T.astype(np.float64) + tensors[f"{name}.layers.{idx}.bias"]
        idx += 1
    return rows


def normalized(tensors, observation):
    parts = []
    for name, values in (("observation", observation["observation"]), ("goal", observation["desired_goal"])):
        mean, std = (tensors[f"normalizer.{name}.{part}"].astype(np.float64) for part in ("mean", "std"))
        parts.append(np.clip((values - mean) / std, -5, 5))
    return np.concatenate(parts, axis=-1)


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.stem)
def test_actions_and_values_are_those_of_the_file_format(path, rng):
    policy = tandem.load_policy(path)
    tensors, observation = policy.tensors(), inputs(policy, rng, 70)
    actions, state = policy.predict(observation)
    expected = np.tanh(network(tensors, "actor", normalized(tensors, observation)))
    assert state is None
    np.testing.assert_allclose(actions, expected, atol=5e-5)
    values = policy.q(observation, actions)
    expected = network(tensors, "critic.0", np.concatenate([normalized(tensors, observation), actions], axis=-1))
    assert values.shape == (70, policy.n_arms)
    np.testing.assert_allclose(values, expected, atol=5e-5, rtol=5e-5)


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.stem)
def test_actions_and_values_have_the_bits_of_rust(path):
    program = os.environ.get("TANDEM_POLICY_PROBE")
    if program is None:
        pytest.skip("TANDEM_POLICY_PROBE names no program: scripts/test-python builds it")
    probe = json.loads(subprocess.run([program, path], stdout=subprocess.PIPE, check=True).stdout)
    policy = tandem.load_policy(path)
    observation = {"observation": probe["observations"], "desired_goal": probe["goals"]}
    actions, _ = policy.predict(observation)
    assert probe["digest"] == policy.digest
    assert np.array_equal(actions, np.array(probe["actions"], np.float32))
    assert np.array_equal(policy.q(observation, actions), np.array(probe["q"], np.float32))


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
def test_a_copied_policy_is_the_same_policy(duplicate, rng):
    policy = tandem.load_policy(POLICIES[0])
    other = duplicate(policy)
    observation = inputs(policy, rng, 2)
    action = policy.predict(observation)[0]
    assert (type(other), other.digest, other.metadata) == (tandem.Policy, policy.digest, policy.metadata)
    assert np.array_equal(other.predict(observation)[0], action)
    assert np.array_equal(other.q(observation, action), policy.q(observation, action))


def test_a_row_has_the_same_bits_in_any_batch(rng):
    policy = tandem.load_policy(POLICIES[0])
    observation = inputs(policy, rng, 9)
    actions, _ = policy.predict(observation)
    row = {name: array[4] for name, array in observation.items()}
    action, _ = policy.predict(row)
    assert action.shape == (policy.n_arms * 4,) or action.shape == (policy.n_arms * 3,)
    assert np.array_equal(action, actions[4])
    assert np.array_equal(policy.q(row, action), policy.q(observation, actions)[4])


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.stem)
def test_a_shipped_policy_succeeds(path):
    policy = tandem.load_policy(path)
    envs = gymnasium.make_vec(policy.env_id, num_envs=16)
    observations, _ = envs.reset(seed=1)
    for _ in range(50):
        actions, _ = policy.predict(observations)
        observations, *_, truncations, infos = envs.step(actions)
    assert truncations.all() and infos["is_success"].mean() >= 0.9


def test_properties_come_from_the_file():
    safetensors = pytest.importorskip("safetensors.numpy")
    path = ROOT / "policies/student-pick-and-place-classic.safetensors"
    policy = tandem.load_policy(path)
    assert (policy.task, policy.n_arms, policy.env_id) == ("pick-and-place", 2, "tandem/TwoArmPickAndPlace-v0")
    assert (policy.n_observation, policy.n_goal, policy.n_action) == (56, 6, 8)
    shared = tandem.load_policy(ROOT / "policies/teacher-push.safetensors")
    assert (shared.task, shared.n_arms, shared.env_id) == ("shared-push", 1, "tandem/SharedPush-v0")
    bar = tandem.load_policy(ROOT / "policies/student-carry-bar.safetensors")
    assert (bar.task, bar.n_arms, bar.env_id) == ("carry-bar", 2, "tandem/CarryBar-v0")
    assert len(policy.digest) == 64 and policy.digest[:12] in repr(policy)
    expected = safetensors.load_file(path)
    tensors = policy.tensors()
    assert sorted(tensors) == sorted(expected)
    assert all(np.array_equal(tensors[name], expected[name]) for name in expected)


def test_wrong_inputs_are_refused(rng):
    policy = tandem.load_policy(POLICIES[0])
    observation = inputs(policy, rng, 3)
    with pytest.raises(ValueError, match="observations have shape"):
        policy.predict({**observation, "observation": observation["observation"][:, 1:]})
    with pytest.raises(ValueError, match="goals have shape"):
        policy.predict({**observation, "desired_goal": observation["desired_goal"][:2]})
    with pytest.raises(ValueError, match="not finite"):
        policy.predict({**observation, "desired_goal": observation["desired_goal"] * np.nan})
    with pytest.raises(ValueError, match="3 dimensions, expected 1 or 2"):
        policy.predict({**observation, "desired_goal": observation["desired_goal"][None]})


def test_an_observation_that_is_no_mapping_or_lacks_an_array_is_refused():
    policy = tandem.load_policy(POLICIES[0])
    expected = 'expected a mapping with "observation" and "desired_goal"'
    action = np.zeros(policy.n_action)
    for call in (policy.predict, lambda observation: policy.q(observation, action)):
        with pytest.raises(TypeError, match=f"the observation is of type ndarray, {expected}"):
            call(np.zeros(28))
        with pytest.raises(KeyError, match=f"the observation has no observation, {expected}"):
            call({})
        with pytest.raises(KeyError, match=f"the observation has no desired_goal, {expected}"):
            call({"observation": np.zeros(policy.n_observation)})


def test_files_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no policy file: '.*absent.safetensors'$"):
        tandem.load_policy(tmp_path / "absent.safetensors")
    model = tmp_path / "actor.ONNX"
    model.write_bytes(b"")
    with pytest.raises(ValueError, match="actor.ONNX is an ONNX model: convert it with `tandem policy import .*actor"):
        tandem.load_policy(model)
    damaged = tmp_path / "damaged.safetensors"
    content = bytearray(POLICIES[0].read_bytes())
    content[-5] ^= 1
    damaged.write_bytes(content)
    with pytest.raises(ValueError, match="digest"):
        tandem.load_policy(damaged)


def test_a_run_directory_gives_its_best_policy(tmp_path):
    with pytest.raises(FileNotFoundError, match="is a directory without policy/best.safetensors: name a policy file"):
        tandem.load_policy(tmp_path)
    best = tmp_path / "policy" / "best.safetensors"
    best.parent.mkdir()
    shutil.copy(POLICIES[0], best)
    assert tandem.load_policy(tmp_path).digest == tandem.load_policy(str(tmp_path)).digest
    assert tandem.load_policy(tmp_path).digest == tandem.load_policy(POLICIES[0]).digest


def test_a_torch_module_gives_the_same_numbers(rng):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    policy = tandem.load_policy(POLICIES[0])
    observation = inputs(policy, rng, 32)
    module = policy.to_torch()
    tensors = [torch.from_numpy(observation[name]) for name in ("observation", "desired_goal")]
    with torch.no_grad():
        actions = module(*tensors)
        values = module.q(*tensors, actions)
    np.testing.assert_allclose(actions, policy.predict(observation)[0], atol=5e-5)
    np.testing.assert_allclose(values, policy.q(observation, actions.numpy()), atol=5e-5, rtol=5e-5)


def test_without_torch_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "torch", None)
    monkeypatch.delitem(__import__("sys").modules, "tandem.torch_policy", raising=False)
    with pytest.raises(ImportError, match="pip install torch"):
        tandem.load_policy(POLICIES[0]).to_torch()
