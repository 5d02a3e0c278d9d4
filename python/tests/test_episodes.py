"""Episodes from logs: every number is that of the environment that played them; damaged and foreign logs."""

import contextlib
import copy
import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from conftest import POLICIES, ROOT
from services import program, service

import tandem

CORPUS = ROOT / "tests/corpus/v0.1"
TESTS = Path(__file__).parent
PER_STEP = "action reward reward_per_arm asked overridden teacher_action q_teacher q_student importance distance"


def run(*arguments):
    subprocess.run([program(), *map(str, arguments)], cwd=ROOT, check=True, stdout=subprocess.DEVNULL, timeout=240)


def train(directory, *arguments):
    """Trains with short evaluations, and records every episode."""
    few = ["--set", "evaluation.episodes=2", "--set", "evaluation.test_episodes=2"]
    run("train", "--quiet", "--no-dashboard", "--record", "all", "--out", directory, *few, *arguments)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The directory of a run of one round in a world that does not vary, and its episodes, which are all recorded."""
    directory = tmp_path_factory.mktemp("runs") / "recorded"
    world = ["--set", "world.randomization=0", "--set", "world.grasped_start_prob=0.5"]
    train(directory, "--task", "pick-and-place", "--max-env-steps", "800", "--seed", "3", *world)
    return directory, list(tandem.read_episodes(directory))


@pytest.fixture
def logs(tmp_path):
    """A directory with the log of an episode."""
    shutil.copy(CORPUS / "episode.mcap", tmp_path / "b.mcap")
    return tmp_path


def check_replay(episode):
    """Executes the actions in the episode's environment, and compares every number bit for bit."""
    env = gymnasium.make(episode.env_id, **episode.env_kwargs)
    observation, _ = env.reset(seed=episode.seed, options={"episode": episode.number})
    for name in ("observation", "achieved_goal"):
        assert np.array_equal(getattr(episode, name)[0], observation[name]), name
    assert np.array_equal(episode.desired_goal, observation["desired_goal"])
    for t, action in enumerate(episode.action):
        observation, reward, _, truncated, info = env.step(action)
        for name in ("observation", "achieved_goal"):
            assert np.array_equal(getattr(episode, name)[t + 1], observation[name]), (name, t)
        contacts = (info["arm_contact"], info["table_contact"])
        assert (episode.reward[t], truncated) == (reward, t + 1 == episode.n_steps)
        assert (episode.arm_contact[t], episode.table_contact[t]) == contacts
    assert episode.success == info["is_success"]
    env.close()


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.stem)
def test_an_evaluation_has_the_bits_of_its_environment_and_policy(path, tmp_path):
    run("eval", "--policy", path, "--episodes", "2", "--record-dir", tmp_path)
    episodes = list(tandem.read_episodes(tmp_path))
    assert [(e.kind, e.seed, e.number) for e in episodes] == [("evaluation", 777, 0), ("evaluation", 777, 1)]
    policy = tandem.load_policy(path)
    for episode in episodes:
        assert (episode.task, episode.n_arms, episode.env_id) == (policy.task, policy.n_arms, policy.env_id)
        assert (episode.policy_digest, episode.n_steps, episode.is_complete) == (policy.digest, 50, True)
        goals = np.repeat(episode.desired_goal[None], 50, axis=0)
        actions, _ = policy.predict({"observation": episode.observation[:-1], "desired_goal": goals})
        assert np.array_equal(episode.action, actions)
        assert episode.success_per_arm.shape == (policy.n_arms,) and episode.success_per_arm.all() == episode.success
        assert not episode.asked.any() and not episode.overridden.any() and np.isnan(episode.q_teacher).all()
        check_replay(episode)


def test_a_run_directory_has_its_episodes_in_the_order_of_their_logs(trained):
    directory, episodes = trained
    assert [e.path for e in episodes] == sorted((directory / "mcap").glob("*.mcap"))
    assert [e.path for e in tandem.read_episodes(str(directory / "mcap"))] == [e.path for e in episodes]
    training = [e for e in episodes if e.kind == "training"]
    assert [e.number for e in training] == list(range(16)) and len(episodes) > 16
    for episode in episodes:
        kind = {"training": "train", "evaluation": "eval"}[episode.kind]
        _, version, number = episode.path.stem.split("-")
        assert (version, int(number)) == (f"{episode.parameter_version:06}", episode.number)
        assert episode.path.name.startswith(kind)
        grasped = 0.5 if kind == "train" else 0.0
        assert episode.env_kwargs == {"substeps": 20, "grasped_start_prob": grasped, "randomization": 0.0}
        assert (episode.run, episode.step_s, episode.description["n_observation"]) == ("recorded", 0.25, 56)
        check_replay(episode)


def test_shapes_types_and_rewards(trained):
    shapes = {name: (50,) for name in ("reward", "asked", "budget_left", "arm_contact", "table_contact")}
    per_arm = ("reward_per_arm", "overridden", "q_teacher", "q_student", "importance", "distance")
    shapes |= {name: (50, 2) for name in per_arm} | {"action": (50, 8), "teacher_action": (50, 8)}
    shapes |= {"observation": (51, 56), "achieved_goal": (51, 6), "desired_goal": (6,)}
    flags = ("asked", "overridden", "arm_contact", "table_contact")
    for episode in trained[1]:
        for name, shape in shapes.items():
            array = getattr(episode, name)
            expected = np.bool_ if name in flags else np.int64 if name == "budget_left" else np.float32
            assert (array.shape, array.dtype) == (shape, expected), name
        goals = np.repeat(episode.desired_goal[None], 50, axis=0)
        assert np.array_equal(episode.reward, tandem.compute_reward(episode.achieved_goal[1:], goals))
        offsets = (episode.achieved_goal[1:] - goals).reshape(50, 2, 3)
        of_arms = -(np.linalg.norm(offsets, axis=-1) > episode.description["tolerance"]).astype(np.float32)
        assert np.array_equal(episode.reward_per_arm, of_arms)


def test_advice_is_that_of_overridden_arms(trained):
    training = [e for e in trained[1] if e.kind == "training"]
    assert any(e.overridden.any() for e in training) and not all(e.overridden.all() for e in training)
    for episode in training:
        of_arm = np.repeat(episode.overridden, 4, axis=1)
        assert np.array_equal(episode.action[of_arm], episode.teacher_action[of_arm])
        assert not (episode.overridden.any(axis=1) & ~episode.asked).any()
        values = (episode.q_teacher, episode.q_student, episode.importance, episode.distance, episode.teacher_action)
        for value in values:
            assert np.array_equal(np.isfinite(value).all(axis=1), episode.asked)
            assert np.array_equal(np.isnan(value).all(axis=1), ~episode.asked)
        assert np.array_equal(episode.importance, episode.q_teacher - episode.q_student, equal_nan=True)
        assert np.array_equal(episode.budget_left >= 0, episode.asked)
        kept = episode.asked[:, None] & ~episode.overridden
        gap = np.linalg.norm((episode.action - episode.teacher_action).reshape(50, 2, 4), axis=-1)
        np.testing.assert_allclose(gap[kept], episode.distance[kept], rtol=1e-5)


def test_an_episode_of_a_task_that_is_not_built_in_has_its_description(tmp_path):
    pytest.importorskip("grpc")
    script, directory = tmp_path / "serve.py", tmp_path / "run"
    served = "tandem.serve('goal_env:Tandem/Point-v0', name='points')"
    script.write_text(f"import sys, tandem; sys.path.insert(0, {str(TESTS)!r})\n{served}\n")
    command = ["--env-command", f"'{sys.executable}' '{script}'", "--max-env-steps", "100"]
    train(directory, "--workers", "1", *command)
    for episode in tandem.read_episodes(directory):
        assert (episode.task, episode.n_arms, episode.n_steps) == ("points", 1, 12)
        assert (episode.env_id, episode.env_kwargs, episode.step_s) == (None, None, None)
        # The observation has the position in reverse order.
        assert episode.description["achieved_goal"] == [2, 1]
        assert np.array_equal(episode.achieved_goal, episode.observation[:, [2, 1]])
        offset = np.linalg.norm(episode.achieved_goal[1:] - episode.desired_goal, axis=1)
        assert np.array_equal(episode.reward, -(offset > episode.description["tolerance"]).astype(np.float32))
        assert episode.success == (episode.reward[-1] == 0)


def test_an_episode_of_a_world_that_varies_is_simulated_again_with_its_bits(tmp_path):
    varied = ["--set", "world.randomization=0.5", "--max-env-steps", "400"]
    train(tmp_path / "run", "--task", "push", "--arms", "1", *varied)
    episodes = list(tandem.read_episodes(tmp_path / "run"))
    assert {episode.kind for episode in episodes} == {"training", "evaluation"}
    for episode in episodes:
        assert episode.env_kwargs["randomization"] == (0.5 if episode.kind == "training" else 0.0)
        check_replay(episode)


def test_a_log_of_an_earlier_version_is_read_and_simulates_to_its_bits():
    (episode,) = tandem.read_episodes(CORPUS / "episode.mcap")
    check_replay(episode)
    assert "success=" in repr(episode) and "observation" not in repr(episode)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
def test_episodes_can_be_copied(duplicate):
    (episode,) = tandem.read_episodes(CORPUS / "episode.mcap")
    other = duplicate(episode)
    assert np.array_equal(other.observation, episode.observation)
    assert (other.path, other.world, other.description) == (episode.path, episode.world, episode.description)


def test_a_damaged_log_ends_no_reading_of_the_others(logs):
    whole = (CORPUS / "episode.mcap").read_bytes()
    (logs / "c.mcap").write_bytes(whole[:20000])
    (logs / "d.mcap").write_bytes(whole[:30000] + bytes([whole[30000] ^ 1]) + whole[30001:])
    (logs / "e.mcap").write_text("text")
    (logs / "f").mkdir()
    shutil.copy(logs / "b.mcap", logs / "f/a.mcap")
    episodes = tandem.read_episodes(logs)
    assert next(episodes).path == logs / "b.mcap"
    for name in ("c.mcap", "d.mcap"):
        with pytest.raises(ValueError, match=f'{name}" is not a complete MCAP file; `tandem mcap recover`'):
            next(episodes)
    with pytest.raises(ValueError, match='e.mcap" is not an MCAP file'):
        next(episodes)
    assert [episode.path for episode in episodes] == [logs / "f/a.mcap"]


def test_a_recovered_log_has_the_steps_whose_result_it_has(tmp_path):
    run("mcap", "recover", CORPUS / "cut-short.mcap", "--to", tmp_path / "recovered.mcap")
    (episode,) = tandem.read_episodes(tmp_path / "recovered.mcap")
    (whole,) = tandem.read_episodes(CORPUS / "episode.mcap")
    n_steps = episode.n_steps
    assert 0 < n_steps < 50
    assert (episode.is_complete, episode.success, episode.success_per_arm) == (False, None, None)
    assert np.array_equal(episode.observation, whole.observation[: n_steps + 1])
    assert np.array_equal(episode.achieved_goal, whole.achieved_goal[: n_steps + 1])
    for name in PER_STEP.split():
        assert np.array_equal(getattr(episode, name), getattr(whole, name)[:n_steps], equal_nan=True), name


def test_logs_of_trials_are_left_out_of_a_directory_and_refused_by_name(logs):
    shutil.copy(CORPUS / "trial.mcap", logs / "a.mcap")
    with pytest.warns(UserWarning, match='1 log of trials or motions left out, the first: ".*a.mcap" is the log of a'):
        assert [episode.path for episode in tandem.read_episodes(logs)] == [logs / "b.mcap"]
    with pytest.raises(ValueError, match="is the log of a trial, not of an episode"):
        next(tandem.read_episodes(logs / "a.mcap"))
    (logs / "b.mcap").unlink()
    with pytest.raises(ValueError, match="no log of an episode among 1 log of trials or motions, the first"):
        next(tandem.read_episodes(logs))


def test_the_log_of_a_motion_is_refused(tmp_path):
    pytest.importorskip("grpc")
    from test_clients import HOME

    with service("bridge", "--driver", "sim", "--record", str(tmp_path)) as address:
        with tandem.Bridge(address) as bridge, bridge.lease() as lease, contextlib.suppress(tandem.ServiceError):
            lease.reset()
            lease.move([HOME], speed=1.0)
    logs = list(tmp_path.glob("*.mcap"))
    if not logs:
        pytest.skip("the machine is too busy to move arms")
    with pytest.raises(ValueError, match="is the log of a bridge's motion, not of an episode"):
        next(tandem.read_episodes(logs[0]))


def test_paths_without_logs_are_refused_at_once(tmp_path):
    with pytest.raises(FileNotFoundError, match="absent does not exist: name a log, a directory of logs or a run"):
        tandem.read_episodes(tmp_path / "absent")
    (tmp_path / "killed.mcap.part").write_bytes(b"")
    with pytest.raises(FileNotFoundError, match=r"no \*.mcap below .*: record episodes by `tandem eval --record-dir"):
        tandem.read_episodes(tmp_path)


def test_logs_that_are_deleted_meanwhile_are_left_out(logs):
    shutil.copy(logs / "b.mcap", logs / "c.mcap")
    episodes, named = tandem.read_episodes(logs), tandem.read_episodes(logs / "b.mcap")
    (logs / "b.mcap").unlink()
    assert [episode.path for episode in episodes] == [logs / "c.mcap"]
    with pytest.raises(FileNotFoundError, match=r'cannot read ".*b.mcap"'):
        next(named)


def test_a_directory_is_read_one_log_at_a_time(logs):
    for number in range(3):
        (logs / f"c{number}.mcap").write_bytes(b"not read yet")
    assert next(iter(tandem.read_episodes(logs))).path == logs / "b.mcap"


def test_the_description_is_that_of_the_task():
    (episode,) = tandem.read_episodes(CORPUS / "episode.mcap")
    expected = json.loads(tandem._native.task_description(episode.task, episode.n_arms))
    assert episode.description == expected
