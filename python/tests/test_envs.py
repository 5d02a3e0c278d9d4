"""The environments: Gymnasium's rules, the bits of Rust, rewards and seeds."""

import copy
import json
import pickle
import subprocess

import gymnasium
import numpy as np
import pytest
from conftest import ENV_IDS
from gymnasium.utils.env_checker import check_env

import tandem
from tandem import _native
from tandem.envs import task_name


def arrays_of(observation):
    return [observation[name] for name in ("observation", "achieved_goal", "desired_goal")]


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_gymnasiums_checker_accepts_the_environment(env_id):
    check_env(gymnasium.make(env_id, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_stable_baselines3s_checker_accepts_the_environment(env_id):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs stable-baselines3")
    checker.check_env(gymnasium.make(env_id).unwrapped, warn=True)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_seed_and_actions_give_the_bits_of_rust(env_id, rng, observe_program):
    env = gymnasium.make(env_id)
    spec = env.spec.kwargs
    for seed, episode in [(1, 0), (7, 3), (2**64 - 1, 12)]:
        n_steps = 50 if seed == 1 else 8
        actions = rng.uniform(-1.2, 1.2, (n_steps, *env.action_space.shape)).astype(np.float32)
        observation, _ = env.reset(seed=seed, options={"episode": episode})
        observations = [observation["observation"]]
        observations += [env.step(action)[0]["observation"] for action in actions]
        task = task_name(spec["task"], spec["world"])
        command = [observe_program, task, str(spec["n_arms"]), str(seed), str(episode)]
        expected = subprocess.run(command, input=actions.tobytes(), stdout=subprocess.PIPE, check=True).stdout
        assert np.concatenate(observations).tobytes() == expected


def test_resets_without_a_seed_continue_its_episodes():
    env, other = gymnasium.make(ENV_IDS[2]), gymnasium.make(ENV_IDS[2])
    env.reset(seed=5)
    env.reset()
    third, _ = env.reset()
    chosen, _ = other.reset(seed=5, options={"episode": 2})
    first, _ = other.reset(seed=5)
    assert all(map(np.array_equal, arrays_of(third), arrays_of(chosen)))
    assert not np.array_equal(third["observation"], first["observation"])


def test_the_world_is_an_argument():
    named = gymnasium.make("tandem/SharedTwoArmPush-v0")
    chosen = tandem.TandemEnv("push", 2, world="shared")
    assert all(map(np.array_equal, arrays_of(named.reset(seed=3)[0]), arrays_of(chosen.reset(seed=3)[0])))
    classic = tandem.TandemEnv(world="classic")
    assert classic.metadata["render_fps"] == 25 and tandem.TandemEnv().metadata["render_fps"] == 4
    with pytest.raises(ValueError, match="unknown world 'moon': expected classic or shared"):
        tandem.TandemEnv(world="moon")


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_an_environment_describes_itself(env_id):
    env = gymnasium.make(env_id)
    spec, own = env.spec.kwargs, env.unwrapped
    assert (own.task, own.n_arms, own.world) == (task_name(spec["task"], spec["world"]), spec["n_arms"], spec["world"])
    assert own.distance_threshold == json.loads(_native.task_description(own.task, own.n_arms))["tolerance"]
    assert own.dt == {"classic": 0.04, "shared": 0.25, "slow": 0.25}[own.world]
    again = eval(repr(own), {"TandemEnv": tandem.TandemEnv})
    assert repr(again) == repr(own) and again.observation_space == own.observation_space
    for name in ("task", "n_arms", "world", "distance_threshold", "dt"):
        with pytest.raises(AttributeError):
            setattr(own, name, getattr(own, name))
    assert repr(tandem.TandemEnv("push", 2)) == "TandemEnv('shared-push', 2)"


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_rewards_and_ends_of_steps_are_those_of_gymnasium_robotics(env_id):
    env = gymnasium.make(env_id)
    env.reset(seed=2)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    goals = observation["achieved_goal"], observation["desired_goal"]
    own = env.unwrapped
    assert reward == own.compute_reward(*goals, info)
    assert terminated == own.compute_terminated(*goals, info)
    assert truncated == own.compute_truncated(*goals, info)


def test_unseeded_environments_differ():
    starts = [gymnasium.make(ENV_IDS[0]).reset()[0]["observation"] for _ in range(2)]
    assert not np.array_equal(*starts)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_an_episode_is_truncated_after_fifty_steps(env_id):
    env = gymnasium.make(env_id)
    env.reset(seed=3)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(50)]
    assert ends == [(False, False)] * 49 + [(False, True)]


def test_rewards_of_steps_are_those_of_compute_reward(rng):
    env = gymnasium.make(ENV_IDS[0])
    env.reset(seed=2)
    for _ in range(20):
        observation, reward, *_, info = env.step(env.action_space.sample())
        goals = observation["achieved_goal"], observation["desired_goal"]
        assert reward == env.unwrapped.compute_reward(*goals, info)
        assert info["is_success"] == (np.linalg.norm(goals[0] - goals[1]) <= 0.05)


def test_rewards_of_batches_change_at_five_centimetres(rng):
    desired = rng.uniform(-0.2, 0.2, (4, 5, 6))
    direction = rng.normal(size=desired.shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    near, far = desired + 0.0499 * direction, desired + 0.0501 * direction
    assert np.array_equal(tandem.compute_reward(near, desired), np.zeros((4, 5)))
    assert np.array_equal(tandem.compute_reward(far, desired), -np.ones((4, 5)))
    single = tandem.compute_reward(far[0, 0], desired[0, 0])
    assert type(single) is float and single == -1.0
    assert tandem.compute_reward(np.zeros((0, 6)), np.zeros((0, 6))).shape == (0,)


def test_each_arm_within_five_centimetres_is_a_success_but_the_reward_is_joint():
    both = np.array([0.04, 0, 0, 0.04, 0, 0])
    assert tandem.compute_reward(both, np.zeros(6)) == -1.0
    assert tandem.compute_reward(both[:3], np.zeros(3)) == 0.0


def test_bad_actions_are_refused_and_change_nothing():
    env = tandem.TandemEnv("push", 2)
    before, _ = env.reset(seed=4)
    for action, message in [
        (np.zeros(5, np.float32), "5"),
        (np.full(6, np.nan, np.float32), "NaN"),
        ([0.0] * 5 + [float("inf")], "inf"),
        (np.zeros((1, 6), np.float32), r"shape \(1, 6\), expected \(6,\)"),
        (np.zeros((6, 1)), r"shape \(6, 1\), expected \(6,\)"),
        (np.float32(0), r"shape \(\), expected \(6,\)"),
        ([[0.0] * 6], r"shape \(1, 6\), expected \(6,\)"),
        (((0,),) * 6, r"shape \(6, 1\), expected \(6,\)"),
        ([[0.0], [0.0, 0.0]], r"rows of different lengths, expected shape \(6,\)"),
        (0, r"shape \(\), expected \(6,\)"),
    ]:
        with pytest.raises(ValueError, match=message):
            env.step(action)
    for action in (None, ["left"] * 6):
        with pytest.raises(TypeError):
            env.step(action)
    after = env.step(np.zeros(6))[0]
    env.reset(seed=4)
    assert np.array_equal(after["observation"], env.step([0] * 6)[0]["observation"])
    assert np.array_equal(before["desired_goal"], after["desired_goal"])


class _Tensor:
    """An array that is no sequence, as PyTorch's are not."""

    def __init__(self, array):
        self._array, self.ndim, self.shape = array, array.ndim, array.shape

    def __array__(self, dtype=None, copy=None):
        return self._array.astype(dtype)


def test_actions_of_other_types_have_the_same_effect(rng):
    env = tandem.TandemEnv("pick-and-place", 2)
    action = rng.uniform(-1, 1, 8).astype(np.float32)
    strided = np.zeros((8, 2), np.float32)
    strided[:, 0] = action
    results = []
    for given in (action, action.astype(np.float64), action.tolist(), strided[:, 0], _Tensor(action)):
        env.reset(seed=1)
        results.append(env.step(given)[0]["observation"])
    assert all(np.array_equal(results[0], result) for result in results[1:])


def test_wrong_arguments_name_what_is_wrong():
    for arguments, message in [
        ({"task": "lift"}, "unknown task 'lift' in world 'shared': expected push, pick-and-place or carry-bar"),
        ({"task": "shared-push", "world": "classic"}, "unknown task 'shared-push' in world 'classic'"),
        ({"n_arms": 3}, "3 arms"),
        ({"n_arms": -1}, "n_arms is -1"),
        ({"substeps": 7}, "substeps"),
        ({"grasped_start_prob": 2.0}, "grasped_start_prob"),
        ({"randomization": 1.5}, r"world.randomization is 1.5: expected a number in \[0, 1\]"),
        ({"randomization": -0.1}, "world.randomization is -0.1"),
        ({"randomization": float("nan")}, "world.randomization is NaN"),
        ({"render_mode": "human"}, "render mode 'human': .* in a window .*needs pygame.*RecordVideo .*needs moviepy"),
        ({"width": 0}, "pixels"),
    ]:
        with pytest.raises(ValueError, match=message):
            tandem.TandemEnv(**arguments)
    env = tandem.TandemEnv()
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(6))
    with pytest.raises(ValueError, match="unknown options"):
        env.reset(options={"epsiode": 1})


def test_a_refused_seed_or_number_changes_nothing():
    env, other = tandem.TandemEnv("push", 1), tandem.TandemEnv("push", 1)
    for each in (env, other):
        each.reset(seed=5)
    for arguments, message in [
        ({"seed": 2**64}, r"seed is 18446744073709551616, expected 0 to 2\*\*64 - 1"),
        ({"seed": -1}, "seed is -1"),
        ({"options": {"episode": -1}}, "episode is -1"),
        ({"seed": 3, "options": {"episode": 2**64}}, "episode is 18446744073709551616"),
        ({"seed": 3.5}, "seed is 3.5, expected an integer"),
        ({"options": {"episode": 1.9}}, "episode is 1.9, expected an integer"),
        ({"options": {"episode": "1"}}, "episode is '1', expected an integer"),
    ]:
        with pytest.raises(ValueError, match=message):
            env.reset(**arguments)
    assert all(map(np.array_equal, arrays_of(env.reset()[0]), arrays_of(other.reset()[0])))


def test_numbers_of_numpy_are_seeds_and_numbers_of_episodes():
    env, other = tandem.TandemEnv("push", 1), tandem.TandemEnv("push", 1)
    start, _ = env.reset(seed=np.uint64(2**64 - 1), options={"episode": np.int32(2)})
    expected, _ = other.reset(seed=2**64 - 1, options={"episode": 2})
    assert all(map(np.array_equal, arrays_of(start), arrays_of(expected)))


def test_the_last_episode_of_a_seed_has_no_next_one():
    env, other = tandem.TandemEnv("push", 1), tandem.TandemEnv("push", 1)
    env.reset(seed=5, options={"episode": 2**64 - 1})
    other.reset(seed=5, options={"episode": 2**64 - 1})
    for _ in range(2):
        with pytest.raises(ValueError, match="of seed 5 has no next one: give a seed or an episode"):
            env.reset()
    stepped = [each.step(np.ones(3))[0] for each in (env, other)]
    assert all(map(np.array_equal, *map(arrays_of, stepped))), "the episode continues"
    env.reset(options={"episode": 6})
    expected, _ = other.reset(seed=5, options={"episode": 7})
    assert all(map(np.array_equal, arrays_of(env.reset()[0]), arrays_of(expected)))


def test_grasped_starts_hold_the_cube_in_the_hand():
    env = tandem.TandemEnv("pick-and-place", 1, grasped_start_prob=1.0)
    gaps = [np.linalg.norm(env.reset(seed=seed)[0]["observation"][6:9]) for seed in range(10)]
    assert max(gaps) < 0.03


def test_contacts_with_the_other_arm_are_reported():
    env = tandem.TandemEnv("pick-and-place", 2)
    env.reset(seed=1)
    towards = np.array([1, 0, 0, 1] * 2, np.float32)
    infos = [env.step(towards)[4] for _ in range(30)]
    assert not infos[0]["arm_contact"] and any(info["arm_contact"] for info in infos)
    assert not any(info["table_contact"] for info in infos)


def test_pictures_show_the_scene():
    env = gymnasium.make(ENV_IDS[3], render_mode="rgb_array", width=320, height=200)
    env.reset(seed=1)
    before = env.render()
    assert before.shape == (200, 320, 3) and before.dtype == np.uint8
    assert np.array_equal(before, env.render())
    for _ in range(10):
        env.step(np.array([0.5, 0.5, 1, 1] * 2, np.float32))
    changed = (before != env.render()).any(axis=-1)
    assert 0.005 < changed.mean() < 0.5
    # The arms' objects and goals are blue and orange.
    red, _, blue = (before[..., channel].astype(int) for channel in range(3))
    assert (blue - red > 60).sum() > 50 and (red - blue > 60).sum() > 50


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
@pytest.mark.parametrize("env_id", [ENV_IDS[0], ENV_IDS[3]])
def test_a_copy_continues_the_episode_with_its_bits(env_id, duplicate, rng):
    env = gymnasium.make(env_id, substeps=10, randomization=1.0).unwrapped
    env.reset(seed=3, options={"episode": 4})
    actions = rng.uniform(-1.2, 1.2, (14, *env.action_space.shape)).astype(np.float32)
    for action in actions[:9]:
        env.step(action)
    simulation = duplicate(env._simulation)
    for action in actions[9:]:
        expected, observation = env.step(action)[0], simulation.step(action)[0]
        assert all(map(np.array_equal, arrays_of(observation), arrays_of(expected)))


def test_a_shallow_copy_has_a_simulation_of_its_own():
    env = tandem.TandemEnv("push", 1)
    env.reset(seed=5)
    other = copy.copy(env)
    expected = other.step(np.ones(3))[0]
    assert np.array_equal(env.step(np.ones(3))[0]["observation"], expected["observation"])


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copied_environment_plays_the_same_episodes(duplicate):
    fresh = tandem.TandemEnv("pick-and-place", 2, grasped_start_prob=0.5)
    with pytest.raises(RuntimeError, match="call reset first"):
        duplicate(fresh).step(np.zeros(8))
    env = gymnasium.make(ENV_IDS[2], randomization=0.5)
    env.reset(seed=5)
    env.step(np.ones(6))
    other = duplicate(env)
    assert other.unwrapped._simulation is not env.unwrapped._simulation
    env.step(-np.ones(6))
    starts = [it.reset()[0]["observation"] for it in (env, other)]
    assert np.array_equal(*starts), "both start episode 1 of seed 5"


def test_subprocesses_of_stable_baselines3_play_the_environment():
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env", reason="needs stable-baselines3")
    envs = vec_env.SubprocVecEnv([_make_push] * 2, start_method="spawn")
    try:
        envs.seed(3)
        started = envs.reset()
    finally:
        envs.close()
    for idx in range(2):
        expected, _ = gymnasium.make(ENV_IDS[0]).reset(seed=3 + idx)
        assert np.array_equal(started["observation"][idx], expected["observation"])


def _make_push():
    return gymnasium.make(ENV_IDS[0])
