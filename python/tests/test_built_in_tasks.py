"""The package's simulated environments and those that `tandem env` serves are the same."""

import contextlib
import json
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from conftest import ENV_IDS, ROOT
from evaluations import check_evaluation
from services import program, service

pytest.importorskip("grpc")

import tandem
from tandem._grpc import open_channel
from tandem._proto import environment_pb2 as pb
from tandem._proto import environment_pb2_grpc

TWO_ARM_PUSH = "tandem/SharedTwoArmPush-v0"


@contextlib.contextmanager
def stub_of(address):
    with open_channel(address) as channel:
        yield environment_pb2_grpc.EnvironmentStub(channel)


@contextlib.contextmanager
def tandem_env(env_id):
    """Runs `tandem env` with the task of an environment, and yields a stub of its service."""
    spec = gymnasium.spec(env_id).kwargs
    # The slow world is that of one task and has no name on the command line.
    world = [] if spec["world"] == "slow" else ["--world", spec["world"]]
    with service("env", "--task", spec["task"], "--arms", str(spec["n_arms"]), *world) as address:
        with stub_of(address) as stub:
            yield stub


def described(stub):
    return stub.Describe(pb.DescribeEnvironmentRequest(), timeout=30).task


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_a_served_environment_has_the_task_of_tandem_env(env_id):
    own = gymnasium.make(env_id).unwrapped
    with tandem_env(env_id) as stub:
        expected = described(stub)
    with tandem.EnvironmentServer(env_id) as server, stub_of(server.address) as stub:
        assert described(stub) == expected
    assert (server.task.name, len(server.task.arms)) == (own.task, own.n_arms)


def test_both_arms_of_a_served_environment_are_described():
    with tandem.EnvironmentServer(TWO_ARM_PUSH) as server:
        task = server.task
    assert (task.name, task.interchangeable_arms, task.reports_contacts) == ("shared-push", True, True)
    assert [tuple(arm.observation) for arm in task.arms] == [tuple(range(28)), tuple(range(28, 56))]
    assert [tuple(arm.action) for arm in task.arms] == [(0, 1, 2), (3, 4, 5)]
    assert [len(arm.position) for arm in task.arms] == [2, 2] and task.recombination_gap > 0
    assert task.reflection.whole_scene and set(task.goal_bound) == {2.0}


def test_an_environment_without_a_spec_and_one_with_settings_have_their_task():
    for env in (tandem.TandemEnv("push", 2), gymnasium.make(TWO_ARM_PUSH, substeps=10, max_episode_steps=20)):
        with tandem.EnvironmentServer(lambda env=env: env) as server:
            assert server.task.to_message() == tandem.Task.built_in("shared-push", 2).to_message()


def test_another_description_needs_another_name():
    with pytest.raises(tandem.ServiceError, match="a name other than that of the built-in task shared-push"):
        tandem.EnvironmentServer(TWO_ARM_PUSH, recombination_gap=0.5)
    with tandem.EnvironmentServer(TWO_ARM_PUSH, recombination_gap=0.5, name="wide-push") as server:
        assert (server.task.name, server.task.recombination_gap, len(server.task.arms)) == ("wide-push", 0.5, 2)


def test_a_wrapper_may_describe_another_task():
    class Described(gymnasium.Wrapper):
        tandem_task = {}

    with tandem.EnvironmentServer(lambda: Described(gymnasium.make(TWO_ARM_PUSH))) as server:
        assert (server.task.name, len(server.task.arms)) == ("tandem/sharedtwoarmpush-v0", 1)


def test_a_shipped_policy_is_evaluated_in_a_served_environment(tmp_path):
    path, n_episodes = ROOT / "policies/student-push.safetensors", 8
    environment = ["--env-command", f"'{sys.executable}' -m tandem.serve {TWO_ARM_PUSH}"]
    command = [program(), "eval", "--policy", str(path), *environment, "--episodes", str(n_episodes), "--seed", "5"]
    result = subprocess.run([*command, "--json"], check=True, timeout=120, cwd=tmp_path, capture_output=True, text=True)
    answer = json.loads(result.stdout)
    check_evaluation(answer, gymnasium.make(TWO_ARM_PUSH), tandem.load_policy(path), 5, n_episodes)


def rows(data, n):
    return np.frombuffer(data, "<f4").reshape(n, -1)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_an_episode_has_the_bits_of_tandem_env_in_worlds_that_vary_too(env_id, rng):
    starts = [(0.0, 3), (0.25, 3), (1.0, 3), (1.0, 4)]
    envs = [gymnasium.make(env_id, randomization=randomization) for randomization, _ in starts]
    n = len(envs)
    actions = rng.uniform(-1, 1, (20, n, *envs[0].action_space.shape)).astype("<f4")
    resets = [
        pb.EnvironmentReset(environment=idx, seed=7, episode=number, randomization=randomization)
        for idx, (randomization, number) in enumerate(starts)
    ]
    requests = [pb.PlayRequest(reset=pb.ResetEnvironments(environments=resets))]
    requests += [pb.PlayRequest(step=pb.StepEnvironments(actions=action.tobytes())) for action in actions]
    with tandem_env(env_id) as stub:
        first, *answers = stub.Play(iter(requests), timeout=60)
    observations = [env.reset(seed=7, options={"episode": number})[0] for env, (_, number) in zip(envs, starts)]
    assert np.array_equal(rows(first.goals, n), [observation["desired_goal"] for observation in observations])
    assert np.array_equal(rows(first.observations, n), [observation["observation"] for observation in observations])
    for action, answer in zip(actions, answers, strict=True):
        steps = [env.step(own) for env, own in zip(envs, action)]
        assert np.array_equal(rows(answer.observations, n), [observation["observation"] for observation, *_ in steps])
        infos = [info for *_, info in steps]
        contacts = [int(info["arm_contact"]) | int(info["table_contact"]) << 1 for info in infos]
        assert [bits & 3 for bits in answer.contacts] == contacts
    differ = [not np.array_equal(*pair) for pair in zip(rows(first.observations, n), rows(first.observations, n)[1:])]
    assert all(differ), "randomization and number both matter"
