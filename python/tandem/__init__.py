"""Environments, policies and services of Tandem: two robot arms, and advice from a policy for one arm.

Importing the package registers nine environments with Gymnasium: `tandem/Push-v0`, `tandem/PickAndPlace-v0`,
`tandem/TwoArmPush-v0` and `tandem/TwoArmPickAndPlace-v0`, and the same tasks in the shared world as
`tandem/SharedPush-v0` and so on; in `tandem/CarryBar-v0` two arms carry a bar. With `pip install 'tandem-rl[fetch]'`
there are two more, in MuJoCo: `tandem/TwoFetchPush-v0` and `tandem/TwoFetchPickAndPlace-v0`.

Servers and clients need gRPC (`pip install 'tandem-rl[grpc]'`); `help(tandem.serve)` describes one of them:

    serve, EnvironmentServer    serve a Gymnasium environment, in which workers play
    serve_policy, PolicyServer  serve a policy, which a teacher consults
    ServedEnv                   an environment with the vectors that its server gives workers
    episode_seed                the seed of an episode on such a server
    Task, Arm                   the description of a task, and of one arm's part of its vectors
    Manipulation                what arms share and success needs, with ArmManipulation and Condition
    Reflection                  a mirror symmetry of a task; FETCH_REFLECTION is that of Fetch
    Teacher                     asks a teacher for advice on a Step
    Learner                     follows the progress of a run
    Bridge                      moves a pair of arms from WayPoint to WayPoint
    ServiceError                a server or a call that failed; CallError and MotionStopped are kinds of it
"""

from typing import TYPE_CHECKING, Any

from tandem.envs import TandemEnv, compute_reward, register_envs
from tandem.episodes import Episode, read_episodes
from tandem.policy import Policy, load_policy
from tandem.vector import TandemVectorEnv

if TYPE_CHECKING:
    from tandem._environments import EnvironmentServer as EnvironmentServer
    from tandem._environments import episode_seed as episode_seed
    from tandem._environments import serve as serve
    from tandem._fetch import FETCH_REFLECTION as FETCH_REFLECTION
    from tandem._grpc import ServiceError as ServiceError
    from tandem._policies import PolicyServer as PolicyServer
    from tandem._policies import serve_policy as serve_policy
    from tandem._served import ServedEnv as ServedEnv
    from tandem._task import Arm as Arm
    from tandem._task import ArmManipulation as ArmManipulation
    from tandem._task import Condition as Condition
    from tandem._task import Manipulation as Manipulation
    from tandem._task import Reflection as Reflection
    from tandem._task import Task as Task
    from tandem.clients import Bridge as Bridge
    from tandem.clients import CallError as CallError
    from tandem.clients import Learner as Learner
    from tandem.clients import MotionStopped as MotionStopped
    from tandem.clients import Step as Step
    from tandem.clients import Teacher as Teacher
    from tandem.clients import WayPoint as WayPoint

    __version__: str

__all__ = ["Episode", "Policy", "TandemEnv", "TandemVectorEnv", "compute_reward", "load_policy", "read_episodes"]

register_envs()

_SERVICES = {
    "_environments": ("EnvironmentServer", "episode_seed", "serve"),
    "_fetch": ("FETCH_REFLECTION",),
    "_grpc": ("ServiceError",),
    "_policies": ("PolicyServer", "serve_policy"),
    "_served": ("ServedEnv",),
    "_task": ("Arm", "ArmManipulation", "Condition", "Manipulation", "Reflection", "Task"),
    "clients": ("Bridge", "CallError", "Learner", "MotionStopped", "Step", "Teacher", "WayPoint"),
}
"""Names whose modules need gRPC, and are imported when they are first used."""


def __getattr__(name: str) -> Any:
    import importlib

    if name == "__version__":
        import importlib.metadata

        return importlib.metadata.version("tandem-rl")
    for module, names in _SERVICES.items():
        if name in names:
            value = getattr(importlib.import_module(f"tandem.{module}"), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    import importlib.util

    # Tools read the value of each name.
    has_grpc = importlib.util.find_spec("grpc") is not None
    lazy = (name for names in _SERVICES.values() for name in names if has_grpc)
    return sorted({*globals(), "__version__", *lazy} - {"Any", "TYPE_CHECKING"})
