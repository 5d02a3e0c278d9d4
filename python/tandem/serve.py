"""Serves a Gymnasium environment: `python -m tandem.serve FetchPush-v4`."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import traceback
from typing import Any, NoReturn

from tandem._environments import LISTEN_VARIABLE, serve
from tandem._grpc import ServiceError
from tandem._describe import DEFAULT_BOUND, UnusableEnvironment
from tandem._fetch import FETCH_REFLECTION
from tandem._task import Arm, ArmManipulation, Condition, Manipulation, Reflection


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(64, f"tandem.serve: {message}\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="python -m tandem.serve",
        description="Serves a Gymnasium environment with goals, in which workers of Tandem play episodes.",
        epilog="""examples:
  python -m tandem.serve FetchPush-v4                        needs gymnasium-robotics and mujoco
  python -m tandem.serve my_package:MyArm-v0 --listen 127.0.0.1:7010
  python -m tandem.serve PandaPush-v3 --workers 4            needs panda-gym
  python -m tandem.serve tandem/TwoFetchPush-v0              two arms; needs gymnasium-robotics and mujoco
  tandem train --env-command 'python -m tandem.serve FetchPush-v4'

Prints "listening on http://HOST:PORT" once it serves. Exit codes: 0 ended as asked, 64 the environment or an option
cannot be used.""",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("env", help="id for gymnasium.make; MODULE:ID imports a module first, such as reach.py")
    parser.add_argument(
        "--listen", metavar="HOST:PORT", help=f"address to listen on [{LISTEN_VARIABLE}, or a free port of 127.0.0.1]"
    )
    parser.add_argument("--kwargs", type=_object, default={}, metavar="JSON", help="arguments of the environment, a JSON object")
    parser.add_argument("--n", type=int, default=64, help="largest number of environments of a stream [%(default)s]")
    parser.add_argument(
        "--workers", type=int, default=1, help="processes that step the environments of a stream [%(default)s]"
    )
    parser.add_argument("--max-streams", type=int, default=16, help="simultaneous streams [%(default)s]")
    parser.add_argument("--name", help="name of the task [the id in lower case]")
    parser.add_argument("--tolerance", type=float, help="distance up to which a goal counts as achieved")
    parser.add_argument("--norm", choices=["euclidean", "maximum"], help="norm of that distance")
    parser.add_argument("--episode-steps", type=int, help="control steps per episode [of the environment's spec]")
    parser.add_argument(
        "--goal-bound", type=float, nargs="+", metavar="BOUND", help="magnitude of each number of a goal [of the space]"
    )
    parser.add_argument(
        "--bound", type=float, help=f"magnitude of numbers without a bound [{DEFAULT_BOUND:g}]"
    )
    _add_arms(parser.add_argument_group("arms", "by default those of the environment's tandem_task, or one arm"))
    parser.add_argument("--token-file", help="file with the access token; required on non-loopback addresses")
    parser.add_argument("--tls-cert", help="certificate chain (PEM): enables TLS")
    parser.add_argument("--tls-key", help="private key of the certificate (PEM)")
    parser.add_argument("--insecure", action="store_true", help="allow calls without a token on any address")
    return parser


def _add_arms(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--arms",
        type=_arms,
        metavar="JSON",
        help="list with an object per arm: lists of indices observation, goal, action and, optionally, position, lateral and hand",
    )
    group.add_argument("--achieved-goal", type=_indices, metavar="JSON", help="indices in the observation [found]")
    group.add_argument(
        "--interchangeable-arms", action="store_true", default=None, help="exchanging arms is another valid transition"
    )
    group.add_argument("--origin-distance", type=float, help="between the origins of two arms along their positions")
    group.add_argument("--recombination-gap", type=float, help="smallest gap between arms that are recombined")
    group.add_argument("--base", type=float, help="coordinate of each arm's base along its positions")
    group.add_argument(
        "--contact-distances",
        type=float,
        nargs=3,
        metavar=("ALONG", "ACROSS", "UP"),
        help="hands that are nearer along all three axes are in contact; for arms with hand",
    )
    group.add_argument(
        "--manipulation",
        type=_manipulation,
        metavar="JSON",
        help="object with shared_object, one_arm_task, success_steps and arms, as tandem.Manipulation",
    )
    group.add_argument(
        "--reflection",
        type=_reflection,
        metavar="fetch|JSON",
        help="mirror symmetry: that of the Fetch environments, or an object as tandem.Reflection",
    )
    group.add_argument(
        "--reports-contacts", action="store_true", default=None, help="infos have arm_contact, and maybe table_contact"
    )


def _object(text: str) -> dict[str, Any]:
    with contextlib.suppress(ValueError):
        given = json.loads(text)
        if isinstance(given, dict):
            return given
    raise argparse.ArgumentTypeError(f"expected a JSON object, got {text!r}")


def _indices(text: str) -> tuple[int, ...]:
    with contextlib.suppress(ValueError):
        return _checked_indices(json.loads(text))
    raise argparse.ArgumentTypeError(f"expected a JSON list of indices, got {text!r}")


def _checked_indices(given: object) -> tuple[int, ...]:
    if isinstance(given, list) and all(type(index) is int and 0 <= index < 4096 for index in given):
        return tuple(given)
    raise ValueError(f"{given!r} is not a list of indices")


def _arms(text: str) -> list[Arm]:
    try:
        return [Arm(**{name: _checked_indices(part) for name, part in arm.items()}) for arm in json.loads(text)]
    except (AttributeError, TypeError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"expected a list of objects with lists of indices: {error}") from None


def _manipulation(text: str) -> Manipulation:
    try:
        given = json.loads(text)
        arms = []
        for arm in given.pop("arms", []):
            conditions = {name: [Condition(**c) for c in arm.pop(name, [])] for name in ("holding", "conditions")}
            arms.append(ArmManipulation(arm.pop("gripper", None), **conditions))
            if arm:
                raise ValueError(f"unknown items: {', '.join(arm)}")
        return Manipulation(**given, arms=arms)
    except (AttributeError, TypeError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"expected an object as tandem.Manipulation: {error}") from None


def _reflection(text: str) -> Reflection:
    if text == "fetch":
        return FETCH_REFLECTION
    try:
        given = json.loads(text)
        moved = tuple((to, place) for to, place in given.pop("moved", ()))
        plane, whole_scene = float(given.pop("plane", 0.0)), bool(given.pop("whole_scene", False))
        places = {name: tuple(places) for name, places in given.items()}
        return Reflection(**places, moved=moved, plane=plane, whole_scene=whole_scene)
    except (AttributeError, TypeError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"expected fetch or an object as tandem.Reflection: {error}") from None


def main() -> int:
    """Runs the command line, and returns the exit code."""
    arguments = vars(_parser().parse_args())
    env, kwargs = arguments.pop("env"), arguments.pop("kwargs")
    try:
        serve((env, kwargs), **arguments)
    except ServiceError as error:
        if isinstance(error, UnusableEnvironment):
            traceback.print_exception(error.__cause__)
        print(f"tandem.serve: {error}", file=sys.stderr)
        return 64
    return 0


if __name__ == "__main__":
    sys.exit(main())
