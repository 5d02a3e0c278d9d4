#!/usr/bin/env python3
"""Asks a running teacher about a few steps of two arms and shows whom it overrides, why, and what that costs.

Usage: python scripts/teacher_client.py 127.0.0.1:7001 [--account NAME] [--strategy mc-q:0.1] [--steps 5]
Needs: pip install grpcio grpcio-reflection protobuf. Message types come from the service itself, by reflection: there
is nothing to generate, and no .proto file is read.

Exit codes: 0 done, 64 the teacher refuses, 75 the teacher is away or does not answer (try again).
"""

import argparse
import collections
import math
import os
import random
import sys

os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # Errors are reported in one line, below.

import grpc
from google.protobuf import descriptor_pool, message_factory
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase

SERVICE = "tandem.v1.Teacher"
ARMS = 2
TS2C_THRESHOLD = "0.1"  # The T of ts2c:T is for the student, which decides on which steps to ask.
DEADLINE_S = 10
TRY_AGAIN = {grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED, grpc.StatusCode.INTERNAL}


class Details(
    collections.namedtuple("Details", "method timeout metadata credentials wait_for_ready compression"),
    grpc.ClientCallDetails,
):
    """The details of a call."""


class EveryCall(grpc.UnaryUnaryClientInterceptor, grpc.StreamStreamClientInterceptor):
    """Attaches the token, if any, and a deadline to every call, including reflection."""

    def __init__(self, token):
        self.metadata = [("authorization", f"Bearer {token}")] if token else []

    def intercept_unary_unary(self, continuation, details, request):
        metadata = [*(details.metadata or []), *self.metadata]
        return continuation(Details(details.method, DEADLINE_S, metadata, None, None, None), request)

    intercept_stream_stream = intercept_unary_unary


class Teacher:
    """The service's methods: `teacher.Describe()`, `teacher.Advise(account="mine", steps=[...])`."""

    def __init__(self, channel):
        database = ProtoReflectionDescriptorDatabase(channel)
        if SERVICE not in database.get_services():
            sys.exit(failed(64, f"no teacher listens there: there is no service {SERVICE}"))
        pool = descriptor_pool.DescriptorPool(database)
        for method in pool.FindServiceByName(SERVICE).methods:
            if not method.client_streaming:
                setattr(self, method.name, self._call(channel, method))

    @staticmethod
    def _call(channel, method):
        request_type = message_factory.GetMessageClass(method.input_type)
        answer_type = message_factory.GetMessageClass(method.output_type)
        call = channel.unary_unary(
            f"/{SERVICE}/{method.name}",
            request_serializer=request_type.SerializeToString,
            response_deserializer=answer_type.FromString,
        )
        return lambda **fields: call(request_type(**fields))


def connect(arguments):
    """Opens a channel to the teacher, with or without TLS, that attaches the token."""
    if arguments.tls_ca:
        with open(arguments.tls_ca, "rb") as file:
            channel = grpc.secure_channel(arguments.address, grpc.ssl_channel_credentials(file.read()))
    else:
        channel = grpc.insecure_channel(arguments.address)
    token = None
    if arguments.token_file:
        with open(arguments.token_file, encoding="ascii") as file:
            token = file.read().strip()
    return grpc.intercept_channel(channel, EveryCall(token))


def random_steps(about, episode, n_steps):
    """Returns steps 0, 1, ... of an episode with made-up numbers of valid shape."""
    draw = random.Random(episode)

    def numbers(per_arm, reach):
        return [draw.uniform(-reach, reach) for _ in range(ARMS * per_arm)]

    return [
        {
            "episode": episode,
            "step": step,
            "observation": numbers(about.n_observation_per_arm, 0.2),
            "goal": numbers(about.n_goal_per_arm, 0.2),
            "proposed_action": numbers(about.n_action_per_arm, 1.0),
        }
        for step in range(n_steps)
    ]


def reason(strategy, arm):
    """Returns the strategy's rule for one arm. With a threshold, the arm is overridden if the left side is larger."""
    name, _, threshold = strategy.partition(":")
    if name == "ts2c":
        threshold = TS2C_THRESHOLD
    if name in ("mc-q", "rlif", "ts2c"):
        return f"importance {arm.importance:+.4f}, threshold {threshold}"
    if name == "mc-act":
        return f"distance {arm.distance:.4f}, threshold {threshold}"
    if name == "mc-act-abs":
        radius = float(threshold) * math.hypot(*arm.teacher_action)
        return f"distance {arm.distance:.4f}, threshold {radius:.4f} ({threshold} of the teacher's action's length)"
    if name == "eamc":
        return f"importance {arm.importance:+.4f}, threshold {threshold} in the budget's second half, none in its first"
    scores = f"importance {arm.importance:+.4f}, distance {arm.distance:.4f}"
    if name == "jsrl":
        return f"{scores}, {strategy}: overridden on the first {threshold} steps"
    return f"{scores}, {strategy}: no threshold"


def show(strategy, answer):
    for step, advice in enumerate(answer.steps):
        print(f"step {step}: {'1 unit charged' if advice.charged else 'nothing charged'}")
        for number, arm in enumerate(advice.arms):
            verdict = "overridden" if arm.overridden else "left alone"
            print(f"  arm {number} {verdict}: {reason(strategy, arm)}")


def talk(teacher, arguments):
    about = teacher.Describe()
    print(f"a teacher of {about.task}, policy {about.policy_digest[:16]}, strategies {', '.join(about.strategies)}")
    terms = {"name": arguments.account, "budget": arguments.budget, "strategy": arguments.strategy}
    account = teacher.OpenAccount(**terms)
    print(f"account {account.name}: {account.left} of {account.budget} units left, strategy {account.strategy}")
    steps = random_steps(about, arguments.episode, arguments.steps)
    answer = teacher.Advise(account=account.name, steps=steps)
    show(account.strategy, answer)
    charged = sum(step.charged for step in answer.steps)
    print(f"{charged} of {len(steps)} steps charged, {answer.budget_left} units left")
    again = teacher.Advise(account=account.name, steps=steps)
    spent = teacher.GetAccount(name=account.name).spent
    is_marked = all(step.repeated for step in again.steps)
    for step in [*answer.steps, *again.steps]:
        step.repeated = False
    same = "the same answers" if again.steps == answer.steps else "OTHER ANSWERS"
    print(f"asked again: {same}, {again.budget_left} units left, {spent} spent in all")
    return 0 if is_marked and (again.steps, again.budget_left) == (answer.steps, answer.budget_left) else 1


def count(text):
    number = int(text)
    if not 0 <= number < 2**63:
        raise argparse.ArgumentTypeError(f"{text} is not a count")
    return number


def failed(code, message):
    print(f"teacher_client: {message}", file=sys.stderr)
    return code


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("address", help="where the teacher listens, HOST:PORT")
    parser.add_argument("--account", default="example", help="name of the account that pays [%(default)s]")
    parser.add_argument("--budget", type=count, default=100, help="its budget, in steps with advice [%(default)s]")
    parser.add_argument("--strategy", default="mc-q:0.1", help="its strategy [%(default)s]")
    parser.add_argument("--episode", type=count, default=1, help="the episode's number; another one has other steps [%(default)s]")
    parser.add_argument("--steps", type=count, default=5, help="how many steps to ask about [%(default)s]")
    parser.add_argument("--token-file", help="file with the token that the teacher demands")
    parser.add_argument("--tls-ca", help="call by TLS and trust certificates that this authority (PEM) has signed")
    arguments = parser.parse_args()
    try:
        return talk(Teacher(connect(arguments)), arguments)
    except grpc.RpcError as error:
        if error.code() in TRY_AGAIN:
            return failed(75, f"{arguments.address} does not answer: {error.details()}")
        return failed(64, f"the teacher refuses: {error.details()}")
    except (OSError, ValueError) as error:
        return failed(64, error)


if __name__ == "__main__":
    sys.exit(main())
