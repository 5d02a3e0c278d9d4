"""Vector environments: their episodes are those of single environments, in every mode and with any threads."""

import copy
import multiprocessing
import pickle

import gymnasium
import numpy as np
import pytest
from conftest import ENV_IDS
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import tandem


def assert_equal(one, other):
    assert type(one) is type(other) or not isinstance(one, dict), (one, other)
    if isinstance(one, dict):
        assert sorted(one) == sorted(other)
        for name in one:
            assert_equal(one[name], other[name])
    elif isinstance(one, np.ndarray) and one.dtype == object:
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    else:
        assert np.array_equal(one, other), (one, other)


def test_make_vec_uses_the_threads_of_rust():
    envs = gymnasium.make_vec(ENV_IDS[0], num_envs=3)
    assert isinstance(envs, tandem.TandemVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, _ = envs.reset(seed=1)
    assert envs.observation_space.contains(observations)
    assert envs.spec.id == ENV_IDS[0]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("env_id", [ENV_IDS[1], ENV_IDS[2]])
def test_gymnasiums_vector_of_single_environments_gives_the_same(env_id, mode):
    arguments = {"max_episode_steps": 6, "randomization": 0.5}
    envs = gymnasium.make_vec(env_id, num_envs=3, autoreset_mode=mode, num_threads=2, **arguments)
    expected = SyncVectorEnv([lambda: gymnasium.make(env_id, **arguments)] * 3, autoreset_mode=mode)
    envs.action_space.seed(1)
    for one, other in zip(envs.reset(seed=9), expected.reset(seed=9), strict=True):
        assert_equal(one, other)
    for _ in range(16):
        actions = envs.action_space.sample()
        for one, other in zip(envs.step(actions), expected.step(actions), strict=True):
            assert_equal(one, other)


def test_environments_that_are_not_reset_automatically_wait_for_a_reset():
    envs = tandem.TandemVectorEnv(3, max_episode_steps=2, autoreset_mode="Disabled")
    actions = np.zeros((3, 6), np.float32)
    with pytest.raises(ValueError, match="environment 0 has no episode"):
        envs.step(actions)
    envs.reset(seed=[4, 5, 6])
    envs.step(actions)
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    *_, truncations, _ = envs.step(actions)
    assert truncations.tolist() == [True, False, True]
    with pytest.raises(ValueError, match="environment 0 has no episode"):
        envs.step(actions)
    observations, _ = envs.reset(seed=np.array(4))
    single, _ = tandem.TandemEnv("push", 2).reset(seed=6)
    assert np.array_equal(observations["observation"][2], single["observation"])


@pytest.mark.parametrize("seed", [None, 4])
def test_environments_left_out_of_the_first_reset_keep_their_seeds(seed):
    envs, all_at_once = (tandem.TandemVectorEnv(3, "push", 1) for _ in range(2))
    for each in (envs, all_at_once):
        each._np_random = np.random.default_rng(7)
    expected = all_at_once.reset(seed=seed)[0]["observation"]
    envs.reset(seed=seed, options={"reset_mask": np.array([True, False, False])})
    observations = envs.reset(options={"reset_mask": np.array([False, True, True])})[0]["observation"]
    assert np.array_equal(observations, expected)


def test_the_number_of_threads_changes_no_bit(rng):
    actions = rng.uniform(-1, 1, (12, 5, 8))
    courses = []
    for num_threads in (1, 3):
        envs = tandem.TandemVectorEnv(5, "pick-and-place", num_threads=num_threads)
        envs.reset(seed=2)
        courses.append([envs.step(action)[0]["observation"] for action in actions])
    assert np.array_equal(*courses)


def test_bad_actions_are_refused_and_move_no_environment():
    envs = tandem.TandemVectorEnv(2, "push", 1)
    envs.reset(seed=1)
    bad = np.zeros((2, 3))
    bad[1, 2] = np.nan
    for actions, message in [
        (bad, "environment 1"),
        (np.zeros((2, 4)), r"\(2, 4\), expected \(2, 3\)"),
        (np.zeros(6), r"\(6,\), expected \(2, 3\)"),
    ]:
        with pytest.raises(ValueError, match=message):
            envs.step(actions)
    after = envs.step(np.ones((2, 3)))[0]["observation"]
    single = tandem.TandemEnv("push", 1)
    single.reset(seed=1)
    assert np.array_equal(after[0], single.step(np.ones(3))[0]["observation"])


def test_arguments_out_of_range_are_refused():
    for name in ("num_envs", "max_episode_steps", "num_threads"):
        for count in (-1, 0, 2**32, 2**64):
            with pytest.raises(ValueError, match=rf"{name} is {count}, expected 1 to 2\*\*32 - 1"):
                tandem.TandemVectorEnv(**{"num_envs": 1, name: count})
    with pytest.raises(ValueError, match="world.randomization is 2: expected a number in"):
        tandem.TandemVectorEnv(1, randomization=2)
    longest = tandem.TandemVectorEnv(1, max_episode_steps=2**32 - 1, num_threads=2**32 - 1)
    assert longest.reset(seed=1)[0]["observation"].shape == (1, 56)


def test_a_refused_reset_changes_nothing():
    envs, other = (tandem.TandemVectorEnv(2, "push", 1) for _ in range(2))
    for each in (envs, other):
        each._np_random = np.random.default_rng(7)
    for arguments, message in [
        ({"seed": [1]}, "seeds has length 1"),
        ({"seed": 1.5}, "seed is 1.5, expected an integer"),
        ({"seed": np.array(1.5)}, r"seed is array\(1.5\), expected an integer"),
        ({"seed": "12"}, "the seed of environment 0 is '1', expected an integer"),
        ({"seed": [1, 2.5]}, "the seed of environment 1 is 2.5, expected an integer"),
        ({"seed": 2**64 - 1}, "the seed of environment 1 is 18446744073709551616"),
        ({"seed": 3, "options": {"reset_mask": [True]}}, r"reset_mask has shape \(1,\), expected \(2,\)"),
        ({"seed": 3, "options": {"mask": [True, True]}}, "unknown options"),
    ]:
        with pytest.raises(ValueError, match=message):
            envs.reset(**arguments)
    assert_equal(envs.reset()[0], other.reset()[0])


def test_an_environment_without_a_seed_of_its_own_continues():
    envs, other = (tandem.TandemVectorEnv(2, "push", 1) for _ in range(2))
    unseeded = envs.reset(seed=[1, None])[0]["observation"][1]
    assert not np.array_equal(unseeded, other.reset(seed=[1, 0])[0]["observation"][1])
    for each in (envs, other):
        each.reset(seed=[4, 5])
    observations = envs.reset(seed=[7, None])[0]["observation"]
    assert np.array_equal(observations[1], other.reset()[0]["observation"][1])
    assert np.array_equal(observations[0], other.reset(seed=7)[0]["observation"][0])


def test_every_environment_is_drawn():
    envs = tandem.TandemVectorEnv(2, render_mode="rgb_array", width=64, height=40)
    envs.reset(seed=1)
    pictures = envs.render()
    single = tandem.TandemEnv(render_mode="rgb_array", width=64, height=40)
    single.reset(seed=2)
    assert len(pictures) == 2 and np.array_equal(pictures[1], single.render())


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda envs: pickle.loads(pickle.dumps(envs))])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_copied_environments_continue_their_episodes_with_the_same_bits(mode, duplicate, rng):
    settings = {"substeps": 10, "randomization": 1.0}
    envs = tandem.TandemVectorEnv(3, "push", 1, max_episode_steps=6, autoreset_mode=mode, **settings)
    for n_steps in (0, 4, 6):
        envs.reset(seed=2)
        for _ in range(n_steps):
            envs.step(rng.uniform(-1, 1, (3, 3)))
        other = duplicate(envs)
        if n_steps == 6 and mode is AutoresetMode.DISABLED:
            envs.reset()
            other.reset()
        for _ in range(2 if mode is AutoresetMode.DISABLED else 5):
            actions = rng.uniform(-1, 1, (3, 3))
            for one, two in zip(envs.step(actions), other.step(actions), strict=True):
                assert_equal(one, two)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="the system does not fork")
def test_environments_of_a_forked_process_continue_with_threads_of_its_own(rng):
    envs = tandem.TandemVectorEnv(3, "push", 1, num_threads=2, substeps=10)
    envs.reset(seed=2)
    actions = rng.uniform(-1, 1, (3, 3))
    context = multiprocessing.get_context("fork")
    received, sent = context.Pipe(duplex=False)
    child = context.Process(target=lambda: sent.send(envs.step(actions)), daemon=True)
    child.start()
    try:
        assert received.poll(60), "the child hangs"
        for one, two in zip(received.recv(), envs.step(actions), strict=True):
            assert_equal(one, two)
        child.join(60)
        assert child.exitcode == 0
    finally:
        child.kill()


def test_processes_of_gymnasiums_vector_play_single_environments(rng):
    envs = AsyncVectorEnv([_make_push] * 2, context="spawn")
    try:
        one, _ = envs.reset(seed=4)
    finally:
        envs.close()
    two, _ = tandem.TandemVectorEnv(2, "push", 1, world="classic").reset(seed=4)
    assert_equal(one, two)


def _make_push():
    return gymnasium.make(ENV_IDS[0])
