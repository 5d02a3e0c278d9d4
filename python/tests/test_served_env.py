"""Environments with the vectors of their servers."""

import copy
import json
import pickle
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from evaluations import check_evaluation
from goal_env import STEPS, PointEnv
from services import program

pytest.importorskip("grpc")

import tandem
from gymnasium.utils.env_checker import check_env
from test_environment_server import Client, reset, step

ID = "goal_env:Tandem/Point-v0"
TESTS = Path(__file__).parent


def served(**kwargs: Any) -> tandem.ServedEnv:
    return tandem.ServedEnv(gymnasium.make(ID, **kwargs))


@pytest.mark.parametrize("contained", [True, False])
def test_an_episode_has_the_bits_of_the_server(contained: bool) -> None:
    actions = np.random.default_rng(3).uniform(-1, 1, (STEPS, 2)).astype(np.float32)
    with tandem.EnvironmentServer((ID, {"contained": contained})) as server:
        answers = Client(server).play([reset([(0, 8)]), *map(step, actions)])
    env = served(contained=contained)
    assert env.task == server.task
    observation, _ = env.reset(seed=tandem.episode_seed(5, 8))
    assert observation["desired_goal"].tobytes() == answers[0].goals
    for answer, action in zip(answers, [None, *actions]):
        if action is not None:
            observation, reward, terminated, truncated, _ = env.step(action)
            achieved, desired = (np.float64(observation[key]) for key in ("achieved_goal", "desired_goal"))
            assert reward == -float(np.linalg.norm(achieved - desired) > 0.25)
        assert observation["observation"].tobytes() == answer.observations
        assert env.observation_space.contains(observation)
    assert (terminated, truncated) == (False, True)


def test_it_is_an_environment_of_gymnasium() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(served(contained=False), skip_render_check=True)
    assert served().action_space == gymnasium.spaces.Box(-1, 1, (2,))
    envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="sync", wrappers=[tandem.ServedEnv])
    observations, _ = envs.reset(seed=1)
    assert observations["observation"].shape == (2, 4)


@pytest.mark.parametrize(
    ("kwargs", "options", "message"),
    [
        ({"dense": True}, {}, "the reward is not sparse"),
        ({}, {"tolerance": 0.3}, "a goal at euclidean distance 0.2"),
        ({}, {"bound": 0.0}, "the bound must be a positive number, not 0.0"),
        ({"fails_at": 3}, {}, "the environment cannot be used: RuntimeError: the motor is on fire"),
        ({"exits_at": 3}, {}, "the environment cannot be used: SystemExit: the motor is gone"),
        ({"moves_goal_at": 5}, {}, "desired_goal changes within an episode"),
        ({}, {"reflection": tandem.Reflection(observation=(-1,))}, "the task cannot be described"),
    ],
)
def test_an_environment_that_cannot_be_served_is_refused(
    kwargs: dict[str, Any], options: dict[str, Any], message: str
) -> None:
    errors = []
    for refuse in (
        lambda: tandem.EnvironmentServer((ID, kwargs), **options),
        lambda: tandem.ServedEnv(gymnasium.make(ID, **kwargs), **options),
    ):
        with pytest.raises(tandem.ServiceError, match=message) as raised:
            refuse()
        errors.append(str(raised.value))
    assert errors[0] == errors[1]
    with pytest.raises(tandem.ServiceError, match="must be a Dict"):
        tandem.ServedEnv(gymnasium.make("CartPole-v1"))


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("terminates_at", f"terminated at step 11 without its goal: an episode always has {STEPS} steps"),
        ("nan_at", r"observation\[2\] is nan, beyond its bound 1000"),
        ("moves_goal_at", "desired_goal changed at step 11: an episode has one goal"),
    ],
)
def test_an_episode_that_breaks_a_rule_is_an_error(argument: str, message: str) -> None:
    env = served(**{argument: 11})
    env.reset(seed=1)
    for _ in range(10):
        env.step(np.zeros(2))
    with pytest.raises(tandem.ServiceError, match=message):
        env.step(np.zeros(2))


def test_an_achieved_goal_does_not_end_an_episode() -> None:
    env = served(threshold=100.0, terminates_at=5)
    env.reset(seed=1)
    ends = [env.step(np.zeros(2))[2:4] for _ in range(STEPS)]
    assert ends == [(False, False)] * (STEPS - 1) + [(False, True)]


def test_an_end_within_the_error_of_a_measured_tolerance_is_at_the_goal() -> None:
    env = served()
    env.reset(seed=1)
    observation = env.step(np.zeros(2))[0]
    apart = float(np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"]))
    own = gymnasium.make(ID, threshold=apart * 1.0001, terminates_at=1)
    env = tandem.ServedEnv(own, tolerance=apart * 0.9995)
    env.reset(seed=1)
    assert env.step(np.zeros(2))[2:4] == (False, False)


def test_actions_outside_their_range_are_refused_and_move_nothing() -> None:
    env = served()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step([0, 0])
    env.reset(seed=1)
    for action, message in [
        ([0, 1.5], r"action\[1\] is 1.5, expected a number in \[-1, 1\]"),
        ([np.nan, 0], r"action\[0\] is nan"),
        ([0], r"the action has shape \[1\], expected \[2\]"),
    ]:
        with pytest.raises(ValueError, match=message):
            env.step(action)
    assert not env.unwrapped.actions
    env.step([1 + 1e-7, -1])
    assert env.unwrapped.actions[0].tolist() == [2, 0]


def test_success_needs_every_condition_of_the_task_for_its_steps() -> None:
    holding = tandem.Condition((1,), 0.15, target=(0.5,))
    manipulation = tandem.Manipulation(success_steps=2, arms=[tandem.ArmManipulation(conditions=[holding])])
    env = tandem.ServedEnv(gymnasium.make(ID, threshold=100.0), manipulation=manipulation)
    env.reset(seed=1)
    env.unwrapped._position = np.array([0.0, 0.26])  # observed in reverse order, after a number of noise
    reached = [env.step([0, action]) for action in [1, 1, 1, 1, -1]]  # by 0.1 each, then by 0
    assert [info["is_success"] for *_, info in reached] == [False, True, True, False, False]


def test_several_arms_succeed_one_by_one() -> None:
    arms = [tandem.Arm((3,), (0,), (0,)), tandem.Arm((2,), (1,), (1,))]
    task = served().task
    together = np.float32([0, 0.2, 0.2, 7]), np.zeros(2, np.float32)
    assert not task.is_success(*together)
    pair = tandem.ServedEnv(gymnasium.make(ID), arms=arms).task
    assert pair.is_success(*together)
    assert not pair.is_success(np.float32([0, 0.2, 0.3, 7]), together[1])


def test_resets_without_a_seed_differ() -> None:
    first, second = served(), served()
    goals = [env.reset()[0]["desired_goal"].tolist() for env in (first, first, second)]
    assert goals[0] != goals[1] and goals[0] != goals[2]


def test_copies_continue_the_episode() -> None:
    env = tandem.ServedEnv(PointEnv(contained=False), episode_steps=STEPS)
    env.reset(seed=1)
    env.step([0.5, 0.5])
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = env.step([1, 1])[0]["observation"].tolist()
    assert all(copied.step([1, 1])[0]["observation"].tolist() == expected for copied in copies)


def test_arguments_that_describe_no_task_are_refused() -> None:
    with pytest.raises(TypeError, match="ServedEnv does not take workers"):
        tandem.ServedEnv(gymnasium.make(ID), workers=2)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A policy that a run trained on a server, and the options of its environment."""
    directory = tmp_path_factory.mktemp("served")
    script = directory / "serve.py"
    env_fn = (ID, {"contained": False, "threshold": 1.0})
    script.write_text(f"import sys, tandem; sys.path.insert(0, {str(TESTS)!r})\ntandem.serve({env_fn!r}, bound=50.0)\n")
    environment = ["--env-command", f"'{sys.executable}' '{script}'"]
    command = [program(), "train", "--quiet", "--no-dashboard", *environment, "--workers", "1", "--seed", "2"]
    small = ["ddpg.n_hidden=32", "evaluation.test_episodes=8"]
    settings = [part for setting in small for part in ("--set", setting)]
    command += [*settings, "--max-env-steps", "1500", "--out", str(directory / "run")]
    subprocess.run(command, check=True, timeout=120, cwd=directory, capture_output=True)
    return directory / "run/policy/last.safetensors", environment


def test_a_policy_has_the_result_of_its_evaluation(run: tuple[Path, list[str]]) -> None:
    path, environment = run
    command = [program(), "eval", "--policy", str(path), *environment, "--episodes", "20", "--seed", "777", "--json"]
    answer = json.loads(subprocess.run(command, check=True, timeout=120, capture_output=True, text=True).stdout)
    policy = tandem.load_policy(path)
    env = tandem.ServedEnv(gymnasium.make(ID, contained=False, threshold=1.0), policy)
    assert 0 < answer["success"] < 1
    check_evaluation(answer, env, policy, 777, 20)


def test_a_policy_describes_its_environment(run: tuple[Path, list[str]]) -> None:
    policy = tandem.load_policy(run[0])
    # Nothing is played, so the environment does not fail, and the server's bound need not be repeated.
    env = tandem.ServedEnv(gymnasium.make(ID, contained=False, fails_at=1), policy)
    assert env.task.tolerance == 1.0 and env.task.goal_bound == (50.0, 50.0)
    described = tandem.ServedEnv(gymnasium.make(ID, contained=False, threshold=1.0), bound=50.0).task
    assert env.task.to_message() == described.to_message()
    with pytest.raises(TypeError, match="ServedEnv with a policy, whose file describes the task, does not take bound"):
        tandem.ServedEnv(gymnasium.make(ID), policy, bound=50.0)
    built_in = tandem.load_policy(TESTS.parents[1] / "policies/student-push.safetensors")
    assert tandem.ServedEnv(gymnasium.make(built_in.env_id), built_in).task == tandem.Task.built_in("shared-push", 2)
    refusal = "not that of task 'shared-push': observation of length 4, not 56"
    with pytest.raises(tandem.ServiceError, match=refusal):
        tandem.ServedEnv(gymnasium.make(ID), built_in)


def test_a_policy_that_gets_other_observations_names_the_wrapper(run: tuple[Path, list[str]]) -> None:
    policy = tandem.load_policy(run[0])
    observation, _ = PointEnv(contained=False).reset(seed=1)
    expected = r"shape \(1, 2\), expected \(1, 4\): tandem.ServedEnv gives an environment the vectors"
    with pytest.raises(ValueError, match=expected):
        policy.predict(observation)
    with pytest.raises(ValueError, match="wrap it in tandem.ServedEnv"):
        policy.env_id


def test_a_policy_of_a_served_task_teaches_without_its_description(run: tuple[Path, list[str]]) -> None:
    with tandem.PolicyServer(tandem.load_policy(run[0])) as server:
        assert server.task == tandem.Task.of_policy(tandem.load_policy(run[0]))
        assert server.task.name == "tandem/point-v0"
