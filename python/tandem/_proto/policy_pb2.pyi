from . import task_pb2 as _task_pb2
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DescribePolicyRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class PolicyDescription(_message.Message):
    __slots__ = ("task", "name", "digest", "has_values")
    TASK_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    DIGEST_FIELD_NUMBER: _ClassVar[int]
    HAS_VALUES_FIELD_NUMBER: _ClassVar[int]
    task: _task_pb2.TaskDescription
    name: str
    digest: str
    has_values: bool
    def __init__(self, task: _Optional[_Union[_task_pb2.TaskDescription, _Mapping]] = ..., name: _Optional[str] = ..., digest: _Optional[str] = ..., has_values: bool = ...) -> None: ...

class EvaluatePolicyRequest(_message.Message):
    __slots__ = ("observations", "goals", "actions", "digest")
    OBSERVATIONS_FIELD_NUMBER: _ClassVar[int]
    GOALS_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    DIGEST_FIELD_NUMBER: _ClassVar[int]
    observations: bytes
    goals: bytes
    actions: bytes
    digest: str
    def __init__(self, observations: _Optional[bytes] = ..., goals: _Optional[bytes] = ..., actions: _Optional[bytes] = ..., digest: _Optional[str] = ...) -> None: ...

class EvaluatePolicyResponse(_message.Message):
    __slots__ = ("actions", "values", "proposed_values")
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    PROPOSED_VALUES_FIELD_NUMBER: _ClassVar[int]
    actions: bytes
    values: bytes
    proposed_values: bytes
    def __init__(self, actions: _Optional[bytes] = ..., values: _Optional[bytes] = ..., proposed_values: _Optional[bytes] = ...) -> None: ...
