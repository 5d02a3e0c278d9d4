"""Two robot arms that learn with advice from a policy for one: environments and policies of Tandem."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tandem._environments import EnvironmentServer as EnvironmentServer
    from tandem._environments import serve as serve
    from tandem._grpc import ServiceError as ServiceError
    from tandem._policies import PolicyServer as PolicyServer
    from tandem._policies import serve_policy as serve_policy
    from tandem._task import Arm as Arm
    from tandem._task import Task as Task
    from tandem.clients import Bridge as Bridge
    from tandem.clients import CallError as CallError
    from tandem.clients import Learner as Learner
    from tandem.clients import MotionStopped as MotionStopped
    from tandem.clients import Step as Step
    from tandem.clients import Teacher as Teacher
    from tandem.clients import WayPoint as WayPoint

_SERVICES = {
    "EnvironmentServer": "tandem._environments",
    "serve": "tandem._environments",
    "ServiceError": "tandem._grpc",
    "PolicyServer": "tandem._policies",
    "serve_policy": "tandem._policies",
    "Arm": "tandem._task",
    "Task": "tandem._task",
    "Bridge": "tandem.clients",
    "CallError": "tandem.clients",
    "Learner": "tandem.clients",
    "MotionStopped": "tandem.clients",
    "Step": "tandem.clients",
    "Teacher": "tandem.clients",
    "WayPoint": "tandem.clients",
}
"""Names whose modules need gRPC, and are imported when they are first used."""


def __getattr__(name: str) -> Any:
    if name not in _SERVICES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_SERVICES[name]), name)
    globals()[name] = value
    return value
