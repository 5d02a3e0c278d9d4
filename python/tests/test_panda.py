"""Panda-gym: its episodes reproduce, and it can be served."""

import gymnasium
import numpy as np
import pytest

pytest.importorskip("panda_gym")

from tandem.panda import CorrectedPanda


def play(env, seed):
    """Returns the observations of an episode in which the hand moves to the object, and so touches it."""
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    course = [observation["observation"]]
    for _ in range(30):
        action = rng.uniform(-0.3, 0.3, env.action_space.shape)
        action[:3] += np.clip(20 * (observation["achieved_goal"][:3] - course[-1][:3]), -1, 1)
        observation, *_ = env.step(action)
        course.append(observation["observation"])
    return np.array(course)


@pytest.mark.parametrize("env_id", ["PandaPush-v3", "PandaPickAndPlace-v3", "PandaSlide-v3"])
def test_an_episode_has_the_bits_of_a_new_environment(env_id):
    used = CorrectedPanda(gymnasium.make(env_id).unwrapped)
    for seed in (8, 7, 9, 8):
        expected = play(gymnasium.make(env_id).unwrapped, seed)
        assert np.array_equal(play(used, seed), expected)


@pytest.mark.parametrize(("env_id", "achieved_goal"), [("PandaReach-v3", (0, 1, 2)), ("PandaPush-v3", (6, 7, 8))])
def test_panda_gym_is_served_with_resets_that_reproduce(env_id, achieved_goal):
    pytest.importorskip("grpc")
    from test_environment_server import Client, reset, step

    import tandem

    with tandem.EnvironmentServer(env_id) as server:
        assert tuple(server.task.achieved_goal) == achieved_goal
        assert (server.task.n_action, server.task.episode_steps, server.task.tolerance) == (3, 50, 0.05)
        downwards = [step([[0.1, 0.1, -1.0]])] * 50
        requests = [reset([(0, 1)]), *downwards, reset([(0, 2)]), *downwards, reset([(0, 1)]), *downwards]
        answers = [answer.observations for answer in Client(server).play(requests)]
    assert answers[:51] == answers[102:]
    assert env_id == "PandaReach-v3" or answers[:51] != answers[51:102]


def test_objects_that_turn_faster_than_panda_gyms_bound_are_served():
    pytest.importorskip("grpc")
    import tandem

    with tandem.EnvironmentServer("PandaPush-v3") as server:
        assert set(server.task.observation_bound) == {1000.0}
