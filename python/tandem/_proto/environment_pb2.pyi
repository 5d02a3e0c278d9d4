from . import task_pb2 as _task_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DescribeEnvironmentRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class EnvironmentDescription(_message.Message):
    __slots__ = ("task", "server", "max_environments")
    TASK_FIELD_NUMBER: _ClassVar[int]
    SERVER_FIELD_NUMBER: _ClassVar[int]
    MAX_ENVIRONMENTS_FIELD_NUMBER: _ClassVar[int]
    task: _task_pb2.TaskDescription
    server: str
    max_environments: int
    def __init__(self, task: _Optional[_Union[_task_pb2.TaskDescription, _Mapping]] = ..., server: _Optional[str] = ..., max_environments: _Optional[int] = ...) -> None: ...

class PlayRequest(_message.Message):
    __slots__ = ("reset", "step")
    RESET_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    reset: ResetEnvironments
    step: StepEnvironments
    def __init__(self, reset: _Optional[_Union[ResetEnvironments, _Mapping]] = ..., step: _Optional[_Union[StepEnvironments, _Mapping]] = ...) -> None: ...

class ResetEnvironments(_message.Message):
    __slots__ = ("environments",)
    ENVIRONMENTS_FIELD_NUMBER: _ClassVar[int]
    environments: _containers.RepeatedCompositeFieldContainer[EnvironmentReset]
    def __init__(self, environments: _Optional[_Iterable[_Union[EnvironmentReset, _Mapping]]] = ...) -> None: ...

class EnvironmentReset(_message.Message):
    __slots__ = ("environment", "seed", "episode", "evaluation", "grasped_start_prob", "substeps", "randomization")
    ENVIRONMENT_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    EVALUATION_FIELD_NUMBER: _ClassVar[int]
    GRASPED_START_PROB_FIELD_NUMBER: _ClassVar[int]
    SUBSTEPS_FIELD_NUMBER: _ClassVar[int]
    RANDOMIZATION_FIELD_NUMBER: _ClassVar[int]
    environment: int
    seed: int
    episode: int
    evaluation: bool
    grasped_start_prob: float
    substeps: int
    randomization: float
    def __init__(self, environment: _Optional[int] = ..., seed: _Optional[int] = ..., episode: _Optional[int] = ..., evaluation: bool = ..., grasped_start_prob: _Optional[float] = ..., substeps: _Optional[int] = ..., randomization: _Optional[float] = ...) -> None: ...

class StepEnvironments(_message.Message):
    __slots__ = ("actions",)
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    actions: bytes
    def __init__(self, actions: _Optional[bytes] = ...) -> None: ...

class PlayResponse(_message.Message):
    __slots__ = ("observations", "goals", "contacts")
    OBSERVATIONS_FIELD_NUMBER: _ClassVar[int]
    GOALS_FIELD_NUMBER: _ClassVar[int]
    CONTACTS_FIELD_NUMBER: _ClassVar[int]
    observations: bytes
    goals: bytes
    contacts: bytes
    def __init__(self, observations: _Optional[bytes] = ..., goals: _Optional[bytes] = ..., contacts: _Optional[bytes] = ...) -> None: ...
