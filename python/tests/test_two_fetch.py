"""Two Fetch robots: each arm is Fetch's own, the arms are exchangeable, and a seed determines an episode."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

gymnasium_robotics = pytest.importorskip("gymnasium_robotics")
pytest.importorskip("mujoco")

import tandem
from tandem.two_fetch import TwoFetchEnv

gymnasium.register_envs(gymnasium_robotics)
IDS = {"push": "tandem/TwoFetchPush-v0", "pick-and-place": "tandem/TwoFetchPickAndPlace-v0"}
ONE_ARM = {"push": "FetchPush-v4", "pick-and-place": "FetchPickAndPlace-v4"}
FAR_M = 3.0


def towards(observation, rng):
    """Returns an action, shape `[4]`, that leads the hand into the cube, with noise."""
    way = observation[3:6] - observation[:3]
    return np.append(np.clip(10 * way + rng.uniform(-0.5, 0.5, 3), -1, 1), rng.uniform(-1, 1))


def observations(env, actions):
    return np.array([env.step(action)[0]["observation"] for action in actions])


def arms_of(observation):
    return observation.reshape(*observation.shape[:-1], 2, 25)


@pytest.mark.parametrize("task", IDS)
def test_gymnasiums_checker_accepts_the_environment(task):
    env = gymnasium.make(IDS[task])
    with pytest.warns(UserWarning, match="Box observation space m.*imum value is"):
        check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=3)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(50)]
    assert ends == [(False, False)] * 49 + [(False, True)]


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize("task", IDS)
def test_an_arm_whose_neighbour_rests_far_away_is_fetchs(task, arm, rng):
    one, two = gymnasium.make(ONE_ARM[task]).unwrapped, TwoFetchEnv(task, distance=FAR_M, close_goals=False)
    for seed in range(3):
        alone, _ = one.reset(seed=seed)
        objects, goals = np.array([[1.25, 0.6]] * 2), np.array([alone["desired_goal"]] * 2)
        objects[arm] = alone["achieved_goal"][:2]
        first = two.start(objects, goals)
        assert np.allclose(arms_of(first["observation"])[arm], alone["observation"], rtol=0, atol=1e-12)
        moved, n_steps = 0.0, 0
        # Fetch's table ends at x = 1.55 m.
        while moved < 0.1 and n_steps < 50 and alone["achieved_goal"][0] < 1.5:
            n_steps += 1
            action = np.zeros(8)
            own = towards(alone["observation"], rng)
            action[4 * arm : 4 * arm + 4] = own
            alone, *_ = one.step(own)
            pair, *_ = two.step(action)
            assert np.allclose(arms_of(pair["observation"])[arm], alone["observation"], rtol=0, atol=1e-7)
            moved = np.linalg.norm(alone["achieved_goal"][:2] - objects[arm])
        assert moved > 0.02, "the hand has pushed the cube"


@pytest.mark.parametrize("task", IDS)
def test_arms_can_be_exchanged(task, rng):
    objects, goals = np.array([[1.45, 0.66], [1.28, 0.84]]), np.array([[1.3, 0.7, 0.42], [1.4, 0.8, 0.42]])
    actions = rng.uniform(-1, 1, (25, 2, 4))
    actions[:, :, 0] = np.abs(actions[:, :, 0])  # towards each other
    one, other = TwoFetchEnv(task, distance=0.3), TwoFetchEnv(task, distance=0.3)
    one.start(objects, goals)
    other.start(objects[::-1], goals[::-1])
    touched = False
    for action in actions:
        first, *_, info = one.step(action.reshape(8))
        second, *_, exchanged_info = other.step(action[::-1].reshape(8))
        touched = touched or info["arm_contact"] or exchanged_info["arm_contact"]
        # MuJoCo finds contacts between meshes iteratively, to about 1e-7 m.
        tolerance = 1e-3 if touched else 1e-9
        first, second = arms_of(first["observation"]), arms_of(second["observation"])
        assert np.allclose(first, second[::-1], rtol=0, atol=tolerance)
    assert touched, "the arms have met"
    assert not np.allclose(first, second, rtol=0, atol=1e-2), "the arms differ"


@pytest.mark.parametrize("task", IDS)
def test_a_seed_and_actions_determine_the_bits(task, rng):
    actions = rng.uniform(-1, 1, (20, 8))
    fresh, used = TwoFetchEnv(task), TwoFetchEnv(task)
    used.reset(seed=1)
    observations(used, actions[::-1])
    starts = [env.reset(seed=9)[0]["observation"] for env in (fresh, used)]
    assert np.array_equal(*starts)
    assert np.array_equal(observations(fresh, actions), observations(used, actions))
    assert not np.array_equal(fresh.reset(seed=10)[0]["observation"], starts[0])


@pytest.mark.parametrize(("close_goals", "nearest", "farthest"), [(True, 0.07, 0.15), (False, 0.1, 1.0)])
def test_starts_and_goals_are_apart_but_the_areas_overlap(close_goals, nearest, farthest):
    env = TwoFetchEnv("push", distance=0.2, close_goals=close_goals)
    reached = []
    for seed in range(40):
        observation, _ = env.reset(seed=seed)
        cubes, goals = (observation[name].reshape(2, 3).copy() for name in ("achieved_goal", "desired_goal"))
        assert np.abs(goals[:, :2] - (1.3455, 0.749)).max() <= 0.151, "goals of Fetch"
        for points in (cubes, goals):
            points[1] = (env.tandem_task["origin_distance"] - points[1, 0], 1.5 - points[1, 1], points[1, 2])
        assert np.linalg.norm((cubes[0] - cubes[1])[:2]) >= 0.1 - 1e-3
        assert nearest <= np.linalg.norm((goals[0] - goals[1])[:2]) <= farthest
        reached.append([goals[0, 0], goals[1, 0]])
        assert observation["desired_goal"][2] == observation["desired_goal"][5] == pytest.approx(0.425, abs=1e-3)
    assert np.max(reached, axis=0)[0] > np.min(reached, axis=0)[1], "the areas of the goals overlap"


@pytest.mark.parametrize(("task", "apart_m"), [("push", 0.1928), ("pick-and-place", 0.1999)])
def test_hands_start_twenty_centimetres_apart_and_in_push_seven_millimetres_less(task, apart_m):
    env = TwoFetchEnv(task, distance=0.2)
    first, second = arms_of(env.reset(seed=1)[0]["observation"])
    assert env.tandem_task["origin_distance"] - first[0] - second[0] == pytest.approx(apart_m, abs=2e-4)


def test_contacts_between_the_robots_are_reported():
    env = TwoFetchEnv("pick-and-place", distance=0.25)
    env.reset(seed=1)
    apart = np.array([-1, 0, 0, 0] * 2, np.float32)
    assert not any(env.step(apart)[4]["arm_contact"] for _ in range(5))
    env.reset(seed=1)
    assert any(env.step(-apart)[4]["arm_contact"] for _ in range(15))


def test_rewards_are_joint_and_success_is_per_arm():
    env = TwoFetchEnv("push", distance=0.5, close_goals=False)
    cubes = np.array([[1.25, 0.65], [1.25, 0.65]])
    heights = np.full((2, 1), 0.4249)
    for offset, reward, is_success in [(0.03, 0.0, True), (0.04, -1.0, True), (0.06, -1.0, False)]:
        env.start(cubes, np.hstack([cubes + [offset, 0.0], heights]))
        observation, got, _, _, info = env.step(np.zeros(8))
        assert (got, info["is_success"]) == (reward, is_success)
        assert got == env.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)


def test_bad_actions_and_arguments_are_refused():
    env = TwoFetchEnv("push")
    env.reset(seed=4)
    for action in (np.zeros(4), np.full(8, np.nan)):
        with pytest.raises(ValueError, match="8 finite numbers"):
            env.step(action)
    with pytest.raises(RuntimeError, match="call reset first"):
        TwoFetchEnv("push").step(np.zeros(8))
    for arguments in ({"task": "lift"}, {"distance": 0.01}, {"distance": 0.5}, {"render_mode": "human"}):
        with pytest.raises(ValueError, match="expected"):
            TwoFetchEnv(**arguments)


def test_a_refused_reset_changes_nothing():
    env, other = TwoFetchEnv("push"), TwoFetchEnv("push")
    for each in (env, other):
        each.reset(seed=4)
    with pytest.raises(ValueError, match="unknown options"):
        env.reset(seed=9, options={"episode": 1})
    assert np.array_equal(env.reset()[0]["observation"], other.reset()[0]["observation"])


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_continues_the_episode_with_its_bits(duplicate, rng):
    env = TwoFetchEnv("pick-and-place")
    env.reset(seed=2)
    observations(env, rng.uniform(-1, 1, (7, 8)))
    other = duplicate(env)
    actions = rng.uniform(-1, 1, (10, 8))
    assert np.array_equal(observations(env, actions), observations(other, actions))
    assert np.array_equal(env.reset()[0]["observation"], other.reset()[0]["observation"])


def reflected(observation):
    """The mirror image of an observation of one arm, shape `[25]`."""
    mirror, image = tandem.FETCH_REFLECTION, observation.copy()
    for to, place in mirror.moved:
        image[to] = observation[place]
    image[list(mirror.observation)] *= -1
    image[list(mirror.position)] = 2 * mirror.plane - image[list(mirror.position)]
    return image


@pytest.mark.parametrize("task", ONE_ARM)
def test_fetch_has_a_mirror_image(task, rng):
    first, second = (gymnasium.make(ONE_ARM[task]).unwrapped for _ in range(2))
    differences_m = []
    for seed in range(10):
        first.reset(seed=seed), second.reset(seed=seed)
        cube = first._utils.get_joint_qpos(first.model, first.data, "object0:joint").copy()
        cube[1] = 2 * tandem.FETCH_REFLECTION.plane - cube[1]
        second._utils.set_joint_qpos(second.model, second.data, "object0:joint", cube)
        second._mujoco.mj_forward(second.model, second.data)
        for _ in range(10):
            action = towards(first._get_obs()["observation"], rng).astype(np.float32)
            mirrored = action * np.array([1, -1, 1, 1], np.float32)
            original, image = (env.step(a)[0]["observation"] for env, a in ((first, action), (second, mirrored)))
            differences_m.append(np.abs(original[:6] - reflected(image)[:6]).max())
    # Contacts amplify small differences.
    assert np.median(differences_m) < 0.003, np.median(differences_m)


@pytest.mark.parametrize("task", IDS)
def test_a_served_arm_is_described_as_the_task_of_its_teacher(task):
    pytest.importorskip("grpc")
    with tandem.EnvironmentServer(ONE_ARM[task], reflection=tandem.FETCH_REFLECTION) as server:
        one = server.task
    with tandem.EnvironmentServer(IDS[task]) as server:
        two = server.task
    same = ("name", "tolerance", "norm", "episode_steps", "reports_contacts", "reflection")
    assert [getattr(two, name) for name in same] == [getattr(one, name) for name in same]
    for idx, arm in enumerate(two.arms):
        for kind, n in (("observation", one.n_observation), ("goal", one.n_goal), ("action", one.n_action)):
            assert list(getattr(arm, kind)) == list(range(n * idx, n * (idx + 1)))
        assert [two.achieved_goal[goal] - 25 * idx for goal in arm.goal] == list(one.achieved_goal)
        assert [two.observation_bound[number] for number in arm.observation] == list(one.observation_bound)
        assert list(arm.position) == [25 * idx, 25 * idx + 3]
    assert two.interchangeable_arms and two.origin_distance > two.recombination_gap > 0
