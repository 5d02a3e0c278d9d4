"""Policy servers, alone and behind a teacher."""

import dataclasses
import json
import subprocess

import numpy as np
import pytest

pytest.importorskip("grpc")

import grpc
import tandem
from services import ROOT, program, refusal, service
from tandem._grpc import open_channel
from tandem._proto import policy_pb2 as pb
from tandem._proto import policy_pb2_grpc

TEACHER = ROOT / "policies" / "teacher-push.safetensors"
STUDENT = ROOT / "policies" / "student-push-classic.safetensors"
PUSH = dataclasses.replace(tandem.Task.built_in("push"), name="my-push")
RNG = np.random.default_rng(4)


def follow(observation, goal):
    """Moves the hand toward the goal."""
    return np.clip(5 * (goal - observation[:, :3]), -1, 1)


def closeness(observation, goal, action):
    return -np.linalg.norm(goal - observation[:, :3] - action, axis=1)


def stub(server):
    return policy_pb2_grpc.PolicyStub(open_channel(server.address))


def evaluate(server, m=3, **changes):
    fields = {
        "observations": RNG.normal(size=(m, 28)).astype("<f4").tobytes(),
        "goals": RNG.normal(size=(m, 3)).astype("<f4").tobytes(),
        **changes,
    }
    return stub(server).Evaluate(pb.EvaluatePolicyRequest(**fields))


def refused(server, **changes):
    with pytest.raises(grpc.RpcError) as raised:
        evaluate(server, **changes)
    return raised.value.code().name, raised.value.details()


def steps(n_steps, n_arms=2, episode=1):
    random = np.random.default_rng(episode)
    return [
        tandem.Step(
            episode,
            step,
            random.uniform(-0.2, 0.2, 28 * n_arms),
            random.uniform(-0.2, 0.2, 3 * n_arms),
            random.uniform(-1, 1, 3 * n_arms),
        )
        for step in range(n_steps)
    ]


def bits(advice):
    """Returns every number of the advice as comparable bytes."""
    return [
        (
            one.action.tobytes(),
            one.charged,
            [(arm.teacher_action.tobytes(), arm.q_teacher, arm.q_student, arm.overridden) for arm in one.arms],
        )
        for one in advice
    ]


def five_states(server):
    """Returns random observations, goals and actions, each of five rows, and the server's answer to them."""
    observations, goals = (RNG.normal(size=(5, n)).astype(np.float32) for n in (28, 3))
    proposed = RNG.uniform(-1, 1, (5, 3)).astype(np.float32)
    answer = evaluate(
        server,
        observations=observations.astype("<f4").tobytes(),
        goals=goals.tobytes(),
        actions=proposed.tobytes(),
        digest=server.digest,
    )
    return observations, goals, proposed, answer


def test_answers_are_those_of_the_functions():
    with tandem.PolicyServer(follow, task="push", value=closeness) as server:
        observations, goals, proposed, answer = five_states(server)
        actions = follow(observations, goals)
        assert answer.actions == actions.astype("<f4").tobytes()
        assert answer.values == closeness(observations, goals, actions).astype("<f4").tobytes()
        assert answer.proposed_values == closeness(observations, goals, proposed).astype("<f4").tobytes()


def test_a_value_function_takes_the_place_of_a_policy_files_critic():
    policy = tandem.load_policy(TEACHER)
    with tandem.PolicyServer(policy, value=closeness) as server:
        observations, goals, proposed, answer = five_states(server)
        assert answer.proposed_values == closeness(observations, goals, proposed).astype("<f4").tobytes()


def test_a_state_is_evaluated_alone_unless_the_policy_is_batched():
    sizes = []

    def act(observation, goal):
        sizes.append(len(observation))
        return follow(observation, goal)

    for batched, expected in ((False, [1, 1, 1]), (True, [3])):
        with tandem.PolicyServer(act, task="push", batched=batched) as server:
            sizes.clear()
            evaluate(server)
            assert sizes == expected


@pytest.mark.parametrize("batched", [False, True])
def test_a_request_without_states_has_an_empty_answer(batched):
    with tandem.PolicyServer(follow, task="push", value=closeness, batched=batched) as server:
        assert evaluate(server, m=0) == pb.EvaluatePolicyResponse()
        assert stub(server).Evaluate(pb.EvaluatePolicyRequest()) == pb.EvaluatePolicyResponse()


def test_the_digest_changes_with_the_policy():
    def gentle(observation, goal):
        return follow(observation, goal) / 2

    def digest(policy, **options):
        with tandem.PolicyServer(policy, task="push", **options) as server:
            return stub(server).Describe(pb.DescribePolicyRequest()).digest

    assert digest(follow) == digest(follow) != digest(gentle)
    assert digest(follow, value=closeness) != digest(follow)
    assert digest(follow, digest="v1") == "v1"
    teacher = tandem.load_policy(TEACHER)
    far = digest(teacher, value=lambda *state: -closeness(*state))
    assert len({teacher.digest, digest(teacher, value=closeness), far}) == 3
    assert digest(teacher) == teacher.digest and digest(teacher, value=closeness, digest="v1") == "v1"


def test_requests_are_validated():
    with tandem.PolicyServer(follow, task="push") as server:
        assert refused(server, digest="other")[0] == "FAILED_PRECONDITION"
        assert refused(server, goals=bytes(4)) == ("INVALID_ARGUMENT", "goals: expected 36 bytes, got 4")
        nan = np.full((3, 3), np.nan, "<f4").tobytes()
        assert refused(server, goals=nan) == ("INVALID_ARGUMENT", "goals[0]: expected a finite number, got nan")
        assert refused(server, actions=nan)[1] == "actions[0]: expected a number in [-1, 1], got nan"
        assert refused(server, m=257)[1] == "observations: expected at most 256 states, got 257"


def test_a_failing_policy_is_reported_and_the_server_goes_on(capsys):
    singular = "the policy raised LinAlgError: Singular matrix (test_policy_server.py:"
    faults = {
        "raise": (lambda: 1 / 0, "the policy raised ZeroDivisionError: division by zero (test_policy_server.py:"),
        "package": (lambda: np.linalg.inv(np.zeros((1, 1))), singular),
        "shape": (lambda: np.zeros((1, 4)), "the policy returned an array of shape [1, 4], expected [1, 3]"),
        "range": (lambda: np.full((1, 3), 1.5), "the policy returned 1.5, expected numbers in [-1, 1]"),
        "nan": (lambda: np.full((1, 3), np.nan), "the policy returned nan, expected numbers in [-1, 1]"),
    }
    fault = []

    def act(observation, goal):
        return faults[fault[0]][0]() if fault else follow(observation, goal)

    with tandem.PolicyServer(act, task="push") as server:
        for name, (_, message) in faults.items():
            fault[:] = [name]
            code, details = refused(server)
            assert code == "INTERNAL" and details.startswith(message), details
            assert refused(server) == (code, details)
            log = capsys.readouterr().err
            assert log.count("Traceback ") == (name in ("raise", "package")), log
            assert not log or log.startswith(details) and "test_policy_server.py\", line" in log, log
            fault.clear()
            assert len(evaluate(server).actions) == 36


@pytest.mark.parametrize(
    ("policy", "options", "message"),
    [
        (lambda o, g: RNG.uniform(-1, 1, (len(o), 3)), {"task": "push"}, "not a function"),
        (lambda o, g: 3 * follow(o, g), {"task": "push"}, "clip its actions"),
        (follow, {"task": "lift"}, 'unknown task "lift"'),
        (follow, {"task": "push", "digest": "a b"}, "'a b' is not a digest"),
        (follow, {}, "give the task"),
        (tandem.load_policy(STUDENT), {}, "drives 1 arm, this one drives 2"),
        (follow, {"task": dataclasses.replace(PUSH, goal_bound=())}, "goal_bound: expected 3 numbers, got 0"),
        (follow, {"task": dataclasses.replace(PUSH, tolerance="5 cm")}, "the task cannot be described"),
        (follow, {"task": dataclasses.replace(PUSH, norm="taxicab")}, "unknown variant `taxicab`"),
    ],
)
def test_a_policy_that_cannot_be_served_is_refused(policy, options, message):
    with pytest.raises(tandem.ServiceError, match=message):
        tandem.PolicyServer(policy, **options)


@pytest.mark.parametrize(
    ("name", "n_arms", "flags"),
    [
        ("push", 1, "--task push --arms 1 --world classic"),
        ("shared-pick-and-place", 2, "--task pick-and-place"),
        ("carry-bar", 2, "--task carry-bar"),
    ],
)
def test_built_in_tasks_are_those_of_the_program(name, n_arms, flags):
    command = [program(), "env", *flags.split(), "--describe"]
    described = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    task = json.loads(json.dumps(dataclasses.asdict(tandem.Task.built_in(name, n_arms))))
    for key in ("name", "n_action", "achieved_goal", "tolerance", "observation_bound"):
        assert task[key] == described[key], key
    for key in ("reflection", "manipulation"):
        assert key not in described or task[key] == described[key], key
    assert [arm["action"] for arm in task["arms"]] == [arm["action"] for arm in described["arms"]]
    assert len(task["arms"]) == n_arms
    with pytest.raises(tandem.ServiceError, match="with 3 arms: expected"):
        tandem.Task.built_in(name, 3)


def test_a_teacher_gives_the_same_advice_from_a_server_as_from_the_file():
    policy = tandem.load_policy(TEACHER)
    with (
        tandem.PolicyServer(policy) as server,
        service("teacher", "--ledger", "memory", "--policy", server.address) as remote,
        service("teacher", "--ledger", "memory", "--policy", str(TEACHER)) as local,
        tandem.Teacher(remote) as remote_teacher,
        tandem.Teacher(local) as local_teacher,
    ):
        assert remote_teacher.describe().policy_digest == policy.digest
        for strategy in ("ea", "mc-q:0.1", "mc-act:0.5", "eamc:0.1"):
            answers = []
            for teacher in (remote_teacher, local_teacher):
                teacher.open_account(strategy, budget=30, strategy=strategy)
                answers.append(bits(teacher.advise(strategy, steps(40))))
                assert answers[-1] == bits(teacher.advise(strategy, steps(40))), "asked again"
            assert answers[0] == answers[1]
            assert remote_teacher.account(strategy) == local_teacher.account(strategy)
            assert remote_teacher.account(strategy).spent > 0


def test_a_teacher_without_values_offers_no_strategy_that_compares_them():
    with (
        tandem.PolicyServer(follow, task="push") as server,
        service("teacher", "--ledger", "memory", "--policy", server.address) as address,
        tandem.Teacher(address) as teacher,
    ):
        assert "ea" in teacher.describe().strategies
        assert not any(name.startswith(("mc-q", "eamc")) for name in teacher.describe().strategies)
        with pytest.raises(tandem.CallError, match="strategy mc-q:0.1 compares values"):
            teacher.open_account("mine", budget=10, strategy="mc-q:0.1")
        teacher.open_account("mine", budget=10, strategy="ea")
        (advice,) = teacher.advise("mine", steps(1))
        assert advice.charged and all(arm.overridden for arm in advice.arms)


def test_an_actor_without_a_critic_has_no_values(tmp_path):
    actor, imported = tmp_path / "actor.onnx", tmp_path / "imported.safetensors"
    for command in (["export", str(TEACHER), "--onnx", str(actor)], ["import", str(actor), "--out", str(imported)]):
        subprocess.run([program(), "policy", *command], check=True, capture_output=True)
    policy = tandem.load_policy(imported)
    assert not policy.has_critic and tandem.load_policy(TEACHER).has_critic
    with pytest.raises(ValueError, match="the policy has no critic"):
        policy.q({"observation": np.zeros(28), "desired_goal": np.zeros(3)}, np.zeros(3))
    with tandem.PolicyServer(policy) as server:
        assert not stub(server).Describe(pb.DescribePolicyRequest()).has_values
        assert len(evaluate(server).actions) == 36 and not evaluate(server).values


def test_an_absent_policy_is_waited_for_and_another_one_is_refused():
    server = tandem.PolicyServer(follow, task="push", digest="v1")
    address = server.address.removeprefix("http://")
    with (
        service("teacher", "--ledger", "memory", "--policy", server.address) as teacher_address,
        tandem.Teacher(teacher_address) as teacher,
    ):
        teacher.open_account("mine", budget=10, strategy="ea")
        (before,) = teacher.advise("mine", steps(1))
        server.stop()
        with pytest.raises(tandem.CallError) as raised:
            teacher.advise("mine", steps(2))
        assert raised.value.code == "UNAVAILABLE" and raised.value.is_temporary
        assert teacher.account("mine").spent == 1, "only the step before"

        with tandem.PolicyServer(follow, task="push", digest="v2", listen=address):
            with pytest.raises(tandem.CallError, match="has changed") as raised:
                teacher.advise("mine", steps(2))
            assert raised.value.code == "FAILED_PRECONDITION"
        with tandem.PolicyServer(follow, task="push", digest="v1", listen=address):
            after = teacher.advise("mine", steps(2))
        assert bits(after[:1]) == bits([before])
        assert teacher.account("mine").spent == 2


def test_a_teacher_refuses_what_is_not_a_policy_server(tmp_path):
    token = tmp_path / "token"
    token.write_text("0123456789abcdef")
    with tandem.PolicyServer(follow, task="push", token_file=token) as server:
        code, line = refusal("teacher", "--ledger", "memory", "--policy", server.address)
        assert code == 64 and "requires a token" in line, line
    with service("bridge", "--driver", "sim") as bridge:
        code, line = refusal("teacher", "--ledger", "memory", "--policy", f"http://{bridge}")
        assert code == 64 and "cannot be used" in line, line


def test_a_run_refuses_a_policy_server_with_a_token(tmp_path):
    token = tmp_path / "token"
    token.write_text("0123456789abcdef")
    with tandem.PolicyServer(follow, task="push", token_file=token) as server:
        code, line = refusal("train", "--teacher", server.address, "--out", str(tmp_path / "run"))
    assert code == 64 and "requires a token" in line, line
    assert not (tmp_path / "run").exists()
