from . import task_pb2 as _task_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DescribeRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class DescribeResponse(_message.Message):
    __slots__ = ("task", "n_observation_per_arm", "n_goal_per_arm", "n_action_per_arm", "arms", "strategies", "policy_digest", "task_description")
    TASK_FIELD_NUMBER: _ClassVar[int]
    N_OBSERVATION_PER_ARM_FIELD_NUMBER: _ClassVar[int]
    N_GOAL_PER_ARM_FIELD_NUMBER: _ClassVar[int]
    N_ACTION_PER_ARM_FIELD_NUMBER: _ClassVar[int]
    ARMS_FIELD_NUMBER: _ClassVar[int]
    STRATEGIES_FIELD_NUMBER: _ClassVar[int]
    POLICY_DIGEST_FIELD_NUMBER: _ClassVar[int]
    TASK_DESCRIPTION_FIELD_NUMBER: _ClassVar[int]
    task: str
    n_observation_per_arm: int
    n_goal_per_arm: int
    n_action_per_arm: int
    arms: _containers.RepeatedCompositeFieldContainer[ArmMap]
    strategies: _containers.RepeatedScalarFieldContainer[str]
    policy_digest: str
    task_description: _task_pb2.TaskDescription
    def __init__(self, task: _Optional[str] = ..., n_observation_per_arm: _Optional[int] = ..., n_goal_per_arm: _Optional[int] = ..., n_action_per_arm: _Optional[int] = ..., arms: _Optional[_Iterable[_Union[ArmMap, _Mapping]]] = ..., strategies: _Optional[_Iterable[str]] = ..., policy_digest: _Optional[str] = ..., task_description: _Optional[_Union[_task_pb2.TaskDescription, _Mapping]] = ...) -> None: ...

class ArmMap(_message.Message):
    __slots__ = ("observation", "goal", "action")
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    GOAL_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    observation: IndexRange
    goal: IndexRange
    action: IndexRange
    def __init__(self, observation: _Optional[_Union[IndexRange, _Mapping]] = ..., goal: _Optional[_Union[IndexRange, _Mapping]] = ..., action: _Optional[_Union[IndexRange, _Mapping]] = ...) -> None: ...

class IndexRange(_message.Message):
    __slots__ = ("start", "end")
    START_FIELD_NUMBER: _ClassVar[int]
    END_FIELD_NUMBER: _ClassVar[int]
    start: int
    end: int
    def __init__(self, start: _Optional[int] = ..., end: _Optional[int] = ...) -> None: ...

class OpenAccountRequest(_message.Message):
    __slots__ = ("name", "budget", "strategy")
    NAME_FIELD_NUMBER: _ClassVar[int]
    BUDGET_FIELD_NUMBER: _ClassVar[int]
    STRATEGY_FIELD_NUMBER: _ClassVar[int]
    name: str
    budget: int
    strategy: str
    def __init__(self, name: _Optional[str] = ..., budget: _Optional[int] = ..., strategy: _Optional[str] = ...) -> None: ...

class GetAccountRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class Account(_message.Message):
    __slots__ = ("name", "budget", "strategy", "spent", "leased", "left", "warning")
    NAME_FIELD_NUMBER: _ClassVar[int]
    BUDGET_FIELD_NUMBER: _ClassVar[int]
    STRATEGY_FIELD_NUMBER: _ClassVar[int]
    SPENT_FIELD_NUMBER: _ClassVar[int]
    LEASED_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    WARNING_FIELD_NUMBER: _ClassVar[int]
    name: str
    budget: int
    strategy: str
    spent: int
    leased: int
    left: int
    warning: str
    def __init__(self, name: _Optional[str] = ..., budget: _Optional[int] = ..., strategy: _Optional[str] = ..., spent: _Optional[int] = ..., leased: _Optional[int] = ..., left: _Optional[int] = ..., warning: _Optional[str] = ...) -> None: ...

class AdviseRequest(_message.Message):
    __slots__ = ("account", "steps", "traceparent")
    ACCOUNT_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    TRACEPARENT_FIELD_NUMBER: _ClassVar[int]
    account: str
    steps: _containers.RepeatedCompositeFieldContainer[StepQuery]
    traceparent: str
    def __init__(self, account: _Optional[str] = ..., steps: _Optional[_Iterable[_Union[StepQuery, _Mapping]]] = ..., traceparent: _Optional[str] = ...) -> None: ...

class StepQuery(_message.Message):
    __slots__ = ("episode", "step", "observation", "goal", "proposed_action", "judged_action", "payer")
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    GOAL_FIELD_NUMBER: _ClassVar[int]
    PROPOSED_ACTION_FIELD_NUMBER: _ClassVar[int]
    JUDGED_ACTION_FIELD_NUMBER: _ClassVar[int]
    PAYER_FIELD_NUMBER: _ClassVar[int]
    episode: int
    step: int
    observation: _containers.RepeatedScalarFieldContainer[float]
    goal: _containers.RepeatedScalarFieldContainer[float]
    proposed_action: _containers.RepeatedScalarFieldContainer[float]
    judged_action: _containers.RepeatedScalarFieldContainer[float]
    payer: int
    def __init__(self, episode: _Optional[int] = ..., step: _Optional[int] = ..., observation: _Optional[_Iterable[float]] = ..., goal: _Optional[_Iterable[float]] = ..., proposed_action: _Optional[_Iterable[float]] = ..., judged_action: _Optional[_Iterable[float]] = ..., payer: _Optional[int] = ...) -> None: ...

class AdviseResponse(_message.Message):
    __slots__ = ("steps", "budget_left")
    STEPS_FIELD_NUMBER: _ClassVar[int]
    BUDGET_LEFT_FIELD_NUMBER: _ClassVar[int]
    steps: _containers.RepeatedCompositeFieldContainer[StepAdvice]
    budget_left: int
    def __init__(self, steps: _Optional[_Iterable[_Union[StepAdvice, _Mapping]]] = ..., budget_left: _Optional[int] = ...) -> None: ...

class StepAdvice(_message.Message):
    __slots__ = ("action", "charged", "arms", "repeated")
    ACTION_FIELD_NUMBER: _ClassVar[int]
    CHARGED_FIELD_NUMBER: _ClassVar[int]
    ARMS_FIELD_NUMBER: _ClassVar[int]
    REPEATED_FIELD_NUMBER: _ClassVar[int]
    action: _containers.RepeatedScalarFieldContainer[float]
    charged: bool
    arms: _containers.RepeatedCompositeFieldContainer[ArmAdvice]
    repeated: bool
    def __init__(self, action: _Optional[_Iterable[float]] = ..., charged: bool = ..., arms: _Optional[_Iterable[_Union[ArmAdvice, _Mapping]]] = ..., repeated: bool = ...) -> None: ...

class ArmAdvice(_message.Message):
    __slots__ = ("teacher_action", "q_teacher", "q_student", "importance", "distance", "overridden")
    TEACHER_ACTION_FIELD_NUMBER: _ClassVar[int]
    Q_TEACHER_FIELD_NUMBER: _ClassVar[int]
    Q_STUDENT_FIELD_NUMBER: _ClassVar[int]
    IMPORTANCE_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    OVERRIDDEN_FIELD_NUMBER: _ClassVar[int]
    teacher_action: _containers.RepeatedScalarFieldContainer[float]
    q_teacher: float
    q_student: float
    importance: float
    distance: float
    overridden: bool
    def __init__(self, teacher_action: _Optional[_Iterable[float]] = ..., q_teacher: _Optional[float] = ..., q_student: _Optional[float] = ..., importance: _Optional[float] = ..., distance: _Optional[float] = ..., overridden: bool = ...) -> None: ...

class OpenLeasesRequest(_message.Message):
    __slots__ = ("account", "episodes", "units_per_episode")
    ACCOUNT_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    UNITS_PER_EPISODE_FIELD_NUMBER: _ClassVar[int]
    account: str
    episodes: _containers.RepeatedScalarFieldContainer[int]
    units_per_episode: int
    def __init__(self, account: _Optional[str] = ..., episodes: _Optional[_Iterable[int]] = ..., units_per_episode: _Optional[int] = ...) -> None: ...

class OpenLeasesResponse(_message.Message):
    __slots__ = ("leases", "account")
    LEASES_FIELD_NUMBER: _ClassVar[int]
    ACCOUNT_FIELD_NUMBER: _ClassVar[int]
    leases: _containers.RepeatedCompositeFieldContainer[Lease]
    account: Account
    def __init__(self, leases: _Optional[_Iterable[_Union[Lease, _Mapping]]] = ..., account: _Optional[_Union[Account, _Mapping]] = ...) -> None: ...

class Lease(_message.Message):
    __slots__ = ("episode", "units", "early_units")
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    UNITS_FIELD_NUMBER: _ClassVar[int]
    EARLY_UNITS_FIELD_NUMBER: _ClassVar[int]
    episode: int
    units: int
    early_units: int
    def __init__(self, episode: _Optional[int] = ..., units: _Optional[int] = ..., early_units: _Optional[int] = ...) -> None: ...

class SettleLeasesRequest(_message.Message):
    __slots__ = ("account", "episodes")
    ACCOUNT_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    account: str
    episodes: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, account: _Optional[str] = ..., episodes: _Optional[_Iterable[int]] = ...) -> None: ...
