"""Environment servers, over the wire."""

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import goal_env
import gymnasium
import numpy as np
import pytest
from goal_env import STEPS, PointEnv
from services import program

pytest.importorskip("grpc")

import grpc
import tandem
from tandem._describe import TaskOptions, describe
from tandem._environments import episode_seed, make
from tandem._grpc import open_channel
from tandem._proto import environment_pb2 as pb
from tandem._proto import environment_pb2_grpc

ID = "goal_env:Tandem/Point-v0"
TESTS = Path(__file__).parent
PAIR = [tandem.Arm((3,), (0,), (0,)), tandem.Arm((2,), (1,), (1,))]


def reset(pairs: list[tuple[int, int]]) -> pb.PlayRequest:
    """Returns a request that resets environments, given as pairs of index and episode."""
    environments = [pb.EnvironmentReset(environment=index, seed=5, episode=episode) for index, episode in pairs]
    return pb.PlayRequest(reset=pb.ResetEnvironments(environments=environments))


def step(actions: Any) -> pb.PlayRequest:
    return pb.PlayRequest(step=pb.StepEnvironments(actions=np.asarray(actions, "<f4").tobytes()))


def floats(data: bytes) -> np.ndarray[Any, Any]:
    return np.frombuffer(data, "<f4")


class Client:
    def __init__(self, server: tandem.EnvironmentServer) -> None:
        self.stub = environment_pb2_grpc.EnvironmentStub(open_channel(server.address))

    def play(self, requests: list[pb.PlayRequest], timeout_s: float = 30) -> list[pb.PlayResponse]:
        return list(self.stub.Play(iter(requests), timeout=timeout_s))

    def refusal(self, requests: list[pb.PlayRequest], timeout_s: float = 30) -> tuple[str, str]:
        with pytest.raises(grpc.RpcError) as raised:
            self.play(requests, timeout_s)
        return raised.value.code().name, raised.value.details()


@pytest.fixture(scope="module")
def server() -> Iterator[tandem.EnvironmentServer]:
    with tandem.EnvironmentServer(ID, n=4) as running:
        yield running


@pytest.fixture(scope="module")
def client(server: tandem.EnvironmentServer) -> Client:
    return Client(server)


def test_a_connection_may_be_probed_while_it_is_idle(server: tandem.EnvironmentServer) -> None:
    def frame(kind: int, flags: int, data: bytes = b"") -> bytes:
        return len(data).to_bytes(3, "big") + bytes([kind, flags, 0, 0, 0, 0]) + data

    settings, ping, goaway, is_answer = 4, 6, 7, 1
    host, port = server.address.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection, connection.makefile("rb") as answers:
        connection.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + frame(settings, 0))
        for number in range(10):
            connection.sendall(frame(ping, 0, bytes([number] * 8)))
            answer = None
            while answer != (ping, is_answer):
                head = answers.read(9)
                answer = (head[3], head[4])
                body = answers.read(int.from_bytes(head[:3], "big"))
                assert head[3] != goaway, body
            assert body == bytes([number] * 8)


def test_the_task_is_found_by_probing(client: Client) -> None:
    described = client.stub.Describe(pb.DescribeEnvironmentRequest())
    task = tandem.Task.from_message(described.task)
    assert (task.name, task.n_observation, task.n_goal, task.n_action) == ("tandem/point-v0", 4, 2, 2)
    assert tuple(task.achieved_goal) == (2, 1), "the position is observed in reverse order"
    assert (task.episode_steps, task.tolerance, task.norm) == (STEPS, 0.25, "euclidean")
    assert tuple(task.observation_bound) == (9.0, 1000.0, 1000.0, 1000.0)
    assert tuple(task.goal_bound) == (1000.0, 1000.0)
    assert len(task.arms) == 1
    assert tuple(task.arms[0].observation) == (0, 1, 2, 3)
    assert described.max_environments == 4


def test_an_episode_has_the_bits_of_the_environment_and_rescaled_actions(client: Client) -> None:
    random = np.random.default_rng(3)
    actions = random.uniform(-1, 1, (STEPS, 2, 2)).astype(np.float32)
    answers = client.play([reset([(0, 8), (1, 9)]), *map(step, actions)])
    for index, episode in enumerate((8, 9)):
        env = PointEnv()
        observation, _ = env.reset(seed=episode_seed(5, episode))
        goal = observation["desired_goal"].astype("<f4")
        assert answers[0].goals[8 * index : 8 * index + 8] == goal.tobytes()
        for answer, action in zip(answers, [None, *actions]):
            if action is not None:
                low, high = action[index].astype(np.float64)
                observation = env.step(np.array([2 * low, (high + 1) / 2]))[0]
            expected = observation["observation"].astype("<f4")
            assert answer.observations[16 * index : 16 * index + 16] == expected.tobytes()
        assert all(env.action_space.contains(action) for action in env.actions)


def test_a_later_reset_may_name_some_environments(client: Client) -> None:
    answers = client.play([reset([(0, 1), (1, 2)]), step([[0, 0], [1, 1]]), reset([(1, 1)]), step([[0, 0], [0, 0]])])
    assert len(answers[2].observations) == 16
    assert answers[2].observations == answers[0].observations[:16], "episode 1 in the other environment"
    assert answers[3].observations[16:] == answers[1].observations[:16]


def test_processes_give_the_same_bits() -> None:
    requests = [reset([(0, 1), (1, 2), (2, 3)]), *[step(np.full((3, 2), 0.25)) for _ in range(STEPS)]]
    with tandem.EnvironmentServer(ID) as one, tandem.EnvironmentServer(ID, workers=2) as two:
        assert Client(one).play(requests) == Client(two).play(requests)


def test_the_seed_of_an_episode_is_documented() -> None:
    assert episode_seed(0, 0) == int.from_bytes(bytes.fromhex("374708ff"), "little")
    assert episode_seed(1, 2) != episode_seed(2, 1)


def test_malformed_requests_are_refused_by_field(client: Client) -> None:
    started = reset([(0, 1), (1, 2)])
    cases = {
        "command: expected reset or step": [pb.PlayRequest()],
        "command: the first request must be reset": [step([[0, 0]])],
        "reset.environments: expected 1 to 4, got 5": [reset([(index, 1) for index in range(5)])],
        "reset.environments: the first request resets environments 0, 1, ... in this order": [reset([(1, 1)])],
        "reset.environments[0].environment: expected 0 to 1, got 2": [started, reset([(2, 1)])],
        "reset.environments[1].environment: 0 is named twice": [started, reset([(0, 1), (0, 2)])],
        "step.actions: expected 16 bytes, got 8": [started, step([[0, 0]])],
        "step.actions[2]: expected a number in [-1, 1], got nan": [started, step([[0, 0], [np.nan, 0]])],
        "step.actions[1]: expected a number in [-1, 1], got 1.5": [started, step([[0, 1.5], [0, 0]])],
    }
    for message, requests in cases.items():
        assert client.refusal(requests) == ("INVALID_ARGUMENT", message)


def place_of(statement: str) -> str:
    """Returns file and line of a statement of `goal_env`."""
    lines = Path(goal_env.__file__).read_text().splitlines()
    (number,) = (number for number, line in enumerate(lines, 1) if line.strip() == statement)
    return f"goal_env.py:{number}"


FIRE = place_of('raise RuntimeError("the motor is on fire")')
GONE = place_of('raise SystemExit("the motor is gone")')


def test_faults_of_environments_are_reported_with_their_text_and_place() -> None:
    """The probe plays 10 steps, so the environment fails at step 11."""
    requests = [reset([(0, 1), (1, 2)]), *[step(np.zeros((2, 2))) for _ in range(11)]]
    for workers in (1, 2):
        with tandem.EnvironmentServer((ID, {"fails_at": 11}), workers=workers) as server:
            client = Client(server)
            for _ in range(2):
                expected = f"environment 0: RuntimeError: the motor is on fire ({FIRE})"
                assert client.refusal(requests) == ("INTERNAL", expected)
            assert len(client.play(requests[:-1])) == 11
    with tandem.EnvironmentServer((ID, {"terminates_at": 11})) as server:
        code, message = Client(server).refusal(requests)
        assert code == "DATA_LOSS" and "terminated at step 11 without its goal" in message
    # Playing the episode again would give the same.
    final = {
        "nan_at": "environment 0: observation[2] is nan, beyond its bound 1000",
        "moves_goal_at": "environment 0: desired_goal changed at step 11: an episode has one goal",
    }
    for argument, expected in final.items():
        for workers in (1, 2):
            with tandem.EnvironmentServer((ID, {argument: 11}), workers=workers) as server:
                assert Client(server).refusal(requests) == ("DATA_LOSS", expected)
    with tandem.EnvironmentServer((ID, {"exits_at": 11})) as server:
        expected = f"environment 0: SystemExit: the motor is gone ({GONE})"
        assert Client(server).refusal(requests) == ("INTERNAL", expected)


@pytest.mark.parametrize("workers", [1, 2])
def test_the_log_has_one_traceback_for_each_place(workers: int, capsys: pytest.CaptureFixture[str]) -> None:
    requests = [reset([(0, 1)]), *[step(np.zeros((1, 2)))] * 11]
    with tandem.EnvironmentServer((ID, {"fails_at": 11}), workers=workers) as server:
        for _ in range(3):
            Client(server).refusal(requests)
    log = capsys.readouterr().err
    assert log.startswith(f"environment 0: RuntimeError: the motor is on fire ({FIRE})\nTraceback "), log
    number = FIRE.partition(":")[2]
    assert log.count("Traceback ") == 1 and f'goal_env.py", line {number}, in step' in log, log
    with tandem.EnvironmentServer((ID, {"nan_at": 11}), workers=workers) as server:
        assert Client(server).refusal(requests)[0] == "DATA_LOSS"
    assert capsys.readouterr().err == "", "a broken rule has no traceback"


def test_an_error_in_a_constructor_is_reported_with_its_place() -> None:
    def broken() -> Any:
        return len(5)  # type: ignore[arg-type]

    gymnasium.register("Tandem/Broken-v0", broken)
    expected = r"cannot be used: TypeError: .* has no len.* \(test_environment_server.py:\d+\)"
    with pytest.raises(tandem.ServiceError, match=expected):
        tandem.EnvironmentServer("Tandem/Broken-v0")


def test_a_run_ends_when_an_environment_terminates_without_its_goal(tmp_path: Path) -> None:
    script = tmp_path / "serve.py"
    served = f"tandem.serve(({ID!r}, {{'terminates_at': 11}}))"
    script.write_text(f"import sys, tandem; sys.path.insert(0, {str(TESTS)!r})\n{served}\n")
    command = [program(), "train", "--quiet", "--no-dashboard", "--workers", "1", "--out", str(tmp_path / "run")]
    command += ["--env-command", f"'{sys.executable}' '{script}'"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stdout, result.stderr.count("\n")) == (65, "", 1), result
    assert "environment 0: the environment terminated at step 11 without its goal" in result.stderr


def test_an_environment_that_breaks_the_rules_is_refused_at_the_start() -> None:
    cases = {
        "nan_at": r"observation\[2\] is nan, expected a finite number",
        "moves_goal_at": "desired_goal changes within an episode",
        "exits_at": "the environment cannot be used: SystemExit: the motor is gone",
    }
    for argument, expected in cases.items():
        with pytest.raises(tandem.ServiceError, match=expected):
            tandem.EnvironmentServer((ID, {argument: 5}))


def test_a_number_beyond_its_bound_is_an_error() -> None:
    with tandem.EnvironmentServer(ID, bound=1.0) as server:
        code, message = Client(server).refusal([reset([(0, 1)])])
        assert code == "DATA_LOSS" and "observation[3] is 7, beyond its bound 1" in message


def test_streams_beyond_the_limit_are_refused() -> None:
    with tandem.EnvironmentServer(ID, max_streams=1) as server:
        client = Client(server)
        first = client.stub.Play(iter([reset([(0, 1)])]))
        next(first)
        held = client.stub.Play(_endless(reset([(0, 1)])))
        # The first stream has ended or holds the room; a held stream keeps it for good.
        deadline = time.monotonic() + 60
        while True:
            try:
                next(held)
                break
            except grpc.RpcError:
                assert time.monotonic() < deadline, "no stream is served after the first one"
                held = client.stub.Play(_endless(reset([(0, 1)])))
        assert client.refusal([reset([(0, 1)])])[0] == "RESOURCE_EXHAUSTED"
        held.cancel()


def _endless(first: pb.PlayRequest) -> Iterator[pb.PlayRequest]:
    yield first
    threading.Event().wait(30)


def test_an_achieved_goal_outside_the_observation_is_appended() -> None:
    task, appends = describe(make((ID, {"contained": False})), TaskOptions())
    assert appends
    assert (task.n_observation, tuple(task.achieved_goal)) == (4, (2, 3))
    arms = [tandem.Arm((0,), (0,), (0,)), tandem.Arm((1,), (1,), (1,))]
    task, _ = describe(make((ID, {"contained": False})), TaskOptions(arms=arms))
    assert [tuple(arm.observation) for arm in task.arms] == [(0, 2), (1, 3)]
    with tandem.EnvironmentServer((ID, {"contained": False})) as server:
        (answer,) = Client(server).play([reset([(0, 4)])])
    env = PointEnv(contained=False)
    observation, _ = env.reset(seed=episode_seed(5, 4))
    assert list(floats(answer.observations)[2:]) == list(observation["achieved_goal"].astype(np.float32))


@pytest.mark.parametrize(
    ("kwargs", "options", "message"),
    [
        ({"dense": True}, {}, "the reward is not sparse"),
        ({}, {"tolerance": 0.3}, "a goal at euclidean distance 0.2"),
        ({}, {"norm": "maximum"}, "a goal at maximum distance"),
        ({}, {"tolerance": -1.0}, "the tolerance must be a positive number"),
        ({}, {"bound": 0.0}, "the bound must be a positive number, not 0.0"),
        ({}, {"goal_bound": (1.0,)}, "goal_bound: expected 2 numbers, got 1"),
        ({}, {"bound": float("nan")}, "the bound must be a positive number, not nan"),
        ({}, {"name": "My env"}, "'My env' is not a name"),
        ({}, {"arms": [tandem.Arm((0, 4), (0,), (0,))]}, "indices of the observation"),
        ({}, {"arms": [tandem.Arm((0,), (0,), (0,)), tandem.Arm((1, 2), (1,), (1,))]}, "differ in length"),
        ({}, {"arms": [PAIR[0], tandem.Arm((2,), (1,), (1,), hand=(2,))]}, "arms[1].hand: expected 0 numbers, got 1"),
        ({}, {"contact_distances": (0.1, 0.1, 0.1)}, "three finite numbers above 0 for arms with hands"),
        ({"fails_at": 3}, {}, "the environment cannot be used: RuntimeError: the motor is on fire"),
        ({}, {"achieved_goal": [1, 2]}, "does not have the achieved goal at [1, 2]"),
        ({}, {"achieved_goal": [1]}, "expected 2 indices from 0 to 3, got [1]"),
        ({}, {"reports_contacts": True, "arms": PAIR}, "have no arm_contact"),
        ({"tandem_task": {"colour": 1}}, {}, "unknown items: colour"),
        ({}, {"n": 0}, "1 to 1024 environments"),
        ({}, {"listen": "0.0.0.0:0"}, "can be reached from other machines"),
        ({}, {"listen": "here"}, "'here' is not an address"),
    ],
)
def test_an_environment_that_cannot_be_served_is_refused(
    kwargs: dict[str, Any], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(tandem.ServiceError, match=re.escape(message)):
        tandem.EnvironmentServer((ID, kwargs), **options)


def test_a_number_that_is_always_zero_has_the_default_bound() -> None:
    env, bound = PointEnv(), np.array([9.0, np.inf, np.inf, 0.0])
    env.observation_space["observation"] = gymnasium.spaces.Box(-bound, bound, dtype=np.float64)
    with tandem.EnvironmentServer(lambda: env, episode_steps=STEPS, bound=50.0) as server:
        assert list(server.task.observation_bound) == [9.0, 50.0, 50.0, 50.0]


def test_an_environment_that_cannot_be_sent_to_processes_is_refused() -> None:
    lock = threading.Lock()

    def env_fn() -> Any:
        with lock:
            return gymnasium.make(ID)

    with pytest.raises(tandem.ServiceError, match="cannot be created in other processes: TypeError: cannot pickle"):
        tandem.EnvironmentServer(env_fn, workers=2)


def test_a_hung_environment_occupies_no_stream_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tandem._environments._GRACE_S", 0.5)
    requests = [reset([(0, 1)]), *[step(np.zeros((1, 2)))] * 11]
    with tandem.EnvironmentServer((ID, {"hangs_at": 11}), workers=2, max_streams=1) as server:
        client = Client(server)
        assert client.refusal(requests, timeout_s=5)[0] == "DEADLINE_EXCEEDED"
        deadline = time.monotonic() + 20
        while True:
            try:
                assert len(client.play(requests[:1])) == 1
                break
            except grpc.RpcError as error:
                assert error.code().name == "RESOURCE_EXHAUSTED" and time.monotonic() < deadline, error
                time.sleep(0.1)


def test_the_norm_is_found() -> None:
    task, _ = describe(make((ID, {"maximum": True})), TaskOptions())
    assert task.norm == "maximum"


def test_environments_without_goals_and_unknown_ids_are_refused() -> None:
    with pytest.raises(tandem.ServiceError, match="must be a Dict"):
        tandem.EnvironmentServer("CartPole-v1")
    with pytest.raises(tandem.ServiceError, match="no environment 'Nowhere-v0'"):
        tandem.EnvironmentServer("Nowhere-v0")
    with pytest.raises(tandem.ServiceError, match="no environment 'nowhere:Env-v0': No module named 'nowhere'"):
        tandem.EnvironmentServer("nowhere:Env-v0")
    for name, expected in [
        ("reach.py", "reach:Reach-v0"),
        ("arms/reach.py:Arm-v1", "arms.reach:Arm-v1"),
        ("../reach.py", "reach:Reach-v0"),
    ]:
        message = f"{name!r} names a file: expected MODULE:ID, such as {expected}, "
        with pytest.raises(tandem.ServiceError, match=re.escape(message)):
            tandem.EnvironmentServer(name)
    with pytest.raises(tandem.ServiceError, match="cannot create environment 'bad!'"):
        tandem.EnvironmentServer("bad!")
    with pytest.raises(tandem.ServiceError, match="cannot create environment .* unexpected keyword argument 'unknown'"):
        tandem.EnvironmentServer((ID, {"unknown": 1}))
    with pytest.raises(tandem.ServiceError, match="give episode_steps"):
        tandem.EnvironmentServer(goal_env.point_env)
    with pytest.raises(tandem.ServiceError, match="the task cannot be described"):
        tandem.EnvironmentServer(ID, reflection=tandem.Reflection(observation=(-1,)))


def test_calls_without_the_token_are_refused(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("0123456789abcdef\n")
    with tandem.EnvironmentServer(ID, token_file=token) as server:
        request = pb.DescribeEnvironmentRequest()
        with_token = environment_pb2_grpc.EnvironmentStub(open_channel(server.address, token))
        assert with_token.Describe(request).max_environments == 64
        assert len(list(with_token.Play(iter([reset([(0, 1)])])))) == 1
        without = Client(server)
        assert without.refusal([reset([(0, 1)])])[0] == "UNAUTHENTICATED"
        with pytest.raises(grpc.RpcError) as raised:
            without.stub.Describe(request)
        assert raised.value.code() == grpc.StatusCode.UNAUTHENTICATED
    token.write_text("short")
    with pytest.raises(tandem.ServiceError, match="does not hold a token"):
        tandem.EnvironmentServer(ID, token_file=token)
    with pytest.raises(tandem.ServiceError, match="cannot use certificate .*token' with key .*token'"):
        tandem.EnvironmentServer(ID, tls_cert=token, tls_key=token)


class Command:
    """`python -m tandem.serve`."""

    def __init__(self, *arguments: str, **environment: str) -> None:
        path = os.pathsep.join(filter(None, [str(TESTS), os.environ.get("PYTHONPATH")]))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tandem.serve", *arguments],
            env={**os.environ, "PYTHONPATH": path, **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def address(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        prefix = "listening on http://127.0.0.1:"
        assert line.startswith(prefix), line + self.end()[1]
        return line.removeprefix("listening on ").strip()

    def end(self) -> tuple[int, str]:
        _, errors = self.process.communicate(timeout=20)
        return self.process.returncode, errors


def test_the_command_serves_until_it_is_terminated() -> None:
    command = Command(ID, "--n", "3", "--kwargs", '{"threshold": 0.5}')
    stub = environment_pb2_grpc.EnvironmentStub(open_channel(command.address()))
    described = stub.Describe(pb.DescribeEnvironmentRequest())
    assert (described.max_environments, described.task.tolerance) == (3, 0.5)
    command.process.send_signal(signal.SIGTERM)
    assert command.end() == (0, "")


def test_the_command_of_a_worker_ends_with_its_standard_input() -> None:
    command = Command(ID, TANDEM_ENV_LISTEN="127.0.0.1:0")
    command.address()
    assert command.process.stdin is not None
    command.process.stdin.close()
    command.process.stdin = None
    assert command.end()[0] == 0


def test_the_command_reports_an_unusable_environment_in_one_line() -> None:
    code, errors = Command(ID, "--kwargs", '{"dense": true}').end()
    assert code == 64
    assert errors.startswith("tandem.serve: the reward is not sparse") and errors.count("\n") == 1, errors


def test_the_command_reports_an_exception_of_the_environment_with_its_traceback() -> None:
    code, errors = Command(ID, "--kwargs", '{"fails_at": 3}').end()
    first, *_, last = errors.splitlines()
    assert (code, first) == (64, "Traceback (most recent call last):")
    expected = f"the environment cannot be used: RuntimeError: the motor is on fire ({FIRE})"
    assert last == f"tandem.serve: {expected}" and "goal_env.py\", line" in errors, errors


def test_fetch_push_is_served_with_its_bits() -> None:
    pytest.importorskip("gymnasium_robotics")
    pytest.importorskip("mujoco")
    with tandem.EnvironmentServer("FetchPush-v4") as server:
        assert (server.task.n_observation, tuple(server.task.achieved_goal)) == (25, (3, 4, 5))
        actions = np.random.default_rng(0).uniform(-1, 1, (50, 2, 4))
        client = Client(server)
        episode = [reset([(0, 3), (1, 4)]), *map(step, actions)]
        first = client.play(episode)
        # Neither an earlier episode in the same environment nor the number of environments matters.
        again = client.play([reset([(0, 9)]), step(actions[0, :1]), reset([(0, 4)]), *[step(a[1:]) for a in actions]])
        assert [answer.observations[100:] for answer in first] == [answer.observations for answer in again[2:]]


def test_a_tolerance_that_the_environment_does_not_name_is_measured() -> None:
    env = PointEnv(threshold=0.175)
    del env.distance_threshold
    env.compute_reward = lambda a, b, info: -float(np.linalg.norm(a - b) > 0.175)  # type: ignore[method-assign]
    task, _ = describe(env, TaskOptions(episode_steps=5))
    assert (task.tolerance, task.norm, task.name) == (0.175, "euclidean", "pointenv")


def with_reward(reward: Callable[[float], float]) -> PointEnv:
    env = PointEnv()
    del env.distance_threshold
    env.compute_reward = lambda a, b, info: reward(float(np.linalg.norm(a - b)))  # type: ignore[method-assign]
    return env


@pytest.mark.parametrize(
    ("reward", "returned"),
    [(lambda apart: -apart, r"-\d\.\d+"), (lambda apart: np.exp(-apart), r"0\.\d+")],
    ids=["a dense reward of a sample, not of the first distance tried", "one that is 1 at the goal"],
)
def test_another_reward_is_refused_before_its_tolerance_is_measured(reward: Any, returned: str) -> None:
    expected = f"the reward is not sparse: compute_reward returned {returned}, and"
    with pytest.raises(tandem.ServiceError, match=expected):
        describe(with_reward(reward), TaskOptions(episode_steps=5))


def test_rewards_of_1_within_the_tolerance_and_0_beyond_it_are_sparse_too() -> None:
    env = with_reward(lambda apart: float(apart <= 0.25))
    assert describe(env, TaskOptions(episode_steps=5))[0].tolerance == 0.25
    expected = r"a goal at euclidean distance 0\.\d+ is not achieved, within the tolerance 0.3"
    with pytest.raises(tandem.ServiceError, match=expected):
        describe(env, TaskOptions(episode_steps=5, tolerance=0.3))


def test_the_packages_own_environments_can_be_served() -> None:
    with tandem.EnvironmentServer("tandem/TwoArmPush-v0", norm="euclidean") as server:
        task = server.task
    assert (task.n_observation, task.n_action, task.episode_steps, task.tolerance) == (56, 6, 50, 0.05)
    assert tuple(task.achieved_goal) == (3, 4, 5, 31, 32, 33)


def test_an_environment_may_describe_itself() -> None:
    arms = [tandem.Arm((2, 3), (0,), (0,), position=(3,)), tandem.Arm((0, 1), (1,), (1,), position=(0,))]
    own = {"arms": arms, "name": "pair", "origin_distance": 2.0, "recombination_gap": 0.5, "bound": 50.0}
    own["goal_bound"] = [3.0, 4.0]
    with tandem.EnvironmentServer((ID, {"tandem_task": own}), name="points", recombination_gap=0.25) as server:
        described = Client(server).stub.Describe(pb.DescribeEnvironmentRequest()).task
    task = tandem.Task.from_message(described)
    assert (task.name, task.origin_distance, task.recombination_gap) == ("points", 2.0, 0.25)
    assert [list(arm.position) for arm in task.arms] == [[3], [0]]
    assert (list(task.observation_bound), list(task.goal_bound)) == ([9.0, 50.0, 50.0, 50.0], [3.0, 4.0])


def test_what_arms_share_and_success_needs_is_described() -> None:
    held = [tandem.Condition((2, 3), 0.5), tandem.Condition((3,), 0.25, target=(2.0,))]
    manipulation = tandem.Manipulation(
        one_arm_task="point",
        success_steps=3,
        arms=(tandem.ArmManipulation(gripper=0, holding=held[:1], conditions=held[1:]), tandem.ArmManipulation()),
    )
    arms = [
        tandem.Arm((2, 3), (0,), (0,), position=(3,), lateral=(2,), hand=(3, 2, 3)),
        tandem.Arm((0, 1), (1,), (1,), position=(0,), lateral=(1,), hand=(0, 1, 0)),
    ]
    own = {"arms": arms, "origin_distance": 2.0, "base": -0.5, "manipulation": manipulation}
    own["contact_distances"] = (0.5, 0.25, 0.125)
    with tandem.EnvironmentServer((ID, {"tandem_task": own})) as server:
        message = Client(server).stub.Describe(pb.DescribeEnvironmentRequest()).task
    first = message.manipulation.arms[0]
    assert (first.gripper, list(first.holding[0].numbers), list(first.conditions[0].target)) == (0, [2, 3], [2.0])
    assert message.manipulation.success_steps == 3
    assert not message.manipulation.arms[1].HasField("gripper")
    assert (message.base, [list(arm.lateral) for arm in message.arms]) == (-0.5, [[2], [1]])
    assert [list(arm.hand) for arm in message.arms] == [[3, 2, 3], [0, 1, 0]]
    assert list(message.contact_distances) == [0.5, 0.25, 0.125]
    assert tandem.Task.from_message(message).to_message() == message
    with tandem.EnvironmentServer(ID, arms=PAIR, manipulation=tandem.Manipulation(shared_object=True)) as server:
        assert Client(server).stub.Describe(pb.DescribeEnvironmentRequest()).task.manipulation.shared_object


def test_a_reflection_is_described() -> None:
    reflection = tandem.Reflection((0,), position=(2,), goal=(1,), action=(1,), moved=((2, 3), (3, 2)), plane=0.75, whole_scene=True)
    with tandem.EnvironmentServer((ID, {"tandem_task": {"reflection": reflection}})) as server:
        message = Client(server).stub.Describe(pb.DescribeEnvironmentRequest()).task
    assert (list(message.reflection.observation), list(message.reflection.goal)) == ([0], [1])
    assert tandem.Task.from_message(message).reflection == reflection
    assert not tandem.Task.built_in("push").to_message().HasField("reflection")


def test_contacts_are_sent_if_the_task_reports_them() -> None:
    requests = [reset([(0, 1), (1, 2)]), *[step(np.zeros((2, 2)))] * 3]
    with tandem.EnvironmentServer((ID, {"contacts": True}), reports_contacts=True) as server:
        assert server.task.reports_contacts
        assert [list(answer.contacts) for answer in Client(server).play(requests)] == [[], [2, 2], [3, 3], [2, 2]]
    with tandem.EnvironmentServer((ID, {"contacts": True})) as server:
        assert [answer.contacts for answer in Client(server).play(requests)] == [b""] * 4
    with tandem.EnvironmentServer(ID, reports_contacts=True) as server:
        assert [list(answer.contacts) for answer in Client(server).play(requests)] == [[], [0, 0], [0, 0], [0, 0]]


def test_the_command_takes_arms_and_refuses_bad_ones() -> None:
    arms = '[{"observation": [3], "goal": [0], "action": [0]}, {"observation": [2], "goal": [1], "action": [1]}]'
    command = Command(ID, "--arms", arms, "--interchangeable-arms", "--achieved-goal", "[2, 1]")
    stub = environment_pb2_grpc.EnvironmentStub(open_channel(command.address()))
    task = stub.Describe(pb.DescribeEnvironmentRequest()).task
    assert [list(arm.observation) for arm in task.arms] == [[3], [2]] and task.interchangeable_arms
    command.process.send_signal(signal.SIGTERM)
    assert command.end() == (0, "")
    code, errors = Command(ID, "--arms", "[1]").end()
    assert code == 64 and "argument --arms: expected a list of objects" in errors and errors.count("\n") == 1
    for option, text, expected in [
        ("--achieved-goal", '["a", 1]', "expected a JSON list of indices"),
        ("--achieved-goal", "5", "expected a JSON list of indices"),
        ("--kwargs", "{foo}", "expected a JSON object, got '{foo}'"),
        ("--arms", '[{"observation": ["a"]}]', "expected a list of objects"),
    ]:
        code, errors = Command(ID, option, text).end()
        assert code == 64 and f"argument {option}: {expected}" in errors and errors.count("\n") == 1, errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_server_that_is_still_starting_ends_when_it_is_asked_to(number: signal.Signals) -> None:
    script = "import time, tandem; tandem.serve(lambda: (print('creating', flush=True), time.sleep(300)))"
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "creating\n"
        process.send_signal(number)
        output, errors = process.communicate(timeout=60)
        assert (process.returncode, output, errors) == (0, "", "")
    finally:
        process.kill()
