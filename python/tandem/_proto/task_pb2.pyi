from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Norm(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    NORM_UNSPECIFIED: _ClassVar[Norm]
    NORM_EUCLIDEAN: _ClassVar[Norm]
    NORM_MAXIMUM: _ClassVar[Norm]
NORM_UNSPECIFIED: Norm
NORM_EUCLIDEAN: Norm
NORM_MAXIMUM: Norm

class TaskDescription(_message.Message):
    __slots__ = ("name", "n_observation", "n_goal", "n_action", "arms", "achieved_goal", "episode_steps", "tolerance", "norm", "interchangeable_arms", "reports_contacts", "observation_bound", "goal_bound", "origin_distance", "recombination_gap", "base", "manipulation", "reflection", "contact_distances")
    NAME_FIELD_NUMBER: _ClassVar[int]
    N_OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    N_GOAL_FIELD_NUMBER: _ClassVar[int]
    N_ACTION_FIELD_NUMBER: _ClassVar[int]
    ARMS_FIELD_NUMBER: _ClassVar[int]
    ACHIEVED_GOAL_FIELD_NUMBER: _ClassVar[int]
    EPISODE_STEPS_FIELD_NUMBER: _ClassVar[int]
    TOLERANCE_FIELD_NUMBER: _ClassVar[int]
    NORM_FIELD_NUMBER: _ClassVar[int]
    INTERCHANGEABLE_ARMS_FIELD_NUMBER: _ClassVar[int]
    REPORTS_CONTACTS_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_BOUND_FIELD_NUMBER: _ClassVar[int]
    GOAL_BOUND_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_DISTANCE_FIELD_NUMBER: _ClassVar[int]
    RECOMBINATION_GAP_FIELD_NUMBER: _ClassVar[int]
    BASE_FIELD_NUMBER: _ClassVar[int]
    MANIPULATION_FIELD_NUMBER: _ClassVar[int]
    REFLECTION_FIELD_NUMBER: _ClassVar[int]
    CONTACT_DISTANCES_FIELD_NUMBER: _ClassVar[int]
    name: str
    n_observation: int
    n_goal: int
    n_action: int
    arms: _containers.RepeatedCompositeFieldContainer[TaskArm]
    achieved_goal: _containers.RepeatedScalarFieldContainer[int]
    episode_steps: int
    tolerance: float
    norm: Norm
    interchangeable_arms: bool
    reports_contacts: bool
    observation_bound: _containers.RepeatedScalarFieldContainer[float]
    goal_bound: _containers.RepeatedScalarFieldContainer[float]
    origin_distance: float
    recombination_gap: float
    base: float
    manipulation: TaskManipulation
    reflection: Reflection
    contact_distances: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, name: _Optional[str] = ..., n_observation: _Optional[int] = ..., n_goal: _Optional[int] = ..., n_action: _Optional[int] = ..., arms: _Optional[_Iterable[_Union[TaskArm, _Mapping]]] = ..., achieved_goal: _Optional[_Iterable[int]] = ..., episode_steps: _Optional[int] = ..., tolerance: _Optional[float] = ..., norm: _Optional[_Union[Norm, str]] = ..., interchangeable_arms: bool = ..., reports_contacts: bool = ..., observation_bound: _Optional[_Iterable[float]] = ..., goal_bound: _Optional[_Iterable[float]] = ..., origin_distance: _Optional[float] = ..., recombination_gap: _Optional[float] = ..., base: _Optional[float] = ..., manipulation: _Optional[_Union[TaskManipulation, _Mapping]] = ..., reflection: _Optional[_Union[Reflection, _Mapping]] = ..., contact_distances: _Optional[_Iterable[float]] = ...) -> None: ...

class Reflection(_message.Message):
    __slots__ = ("observation", "goal", "action", "moved", "position", "plane", "whole_scene")
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    GOAL_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    MOVED_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    PLANE_FIELD_NUMBER: _ClassVar[int]
    WHOLE_SCENE_FIELD_NUMBER: _ClassVar[int]
    observation: _containers.RepeatedScalarFieldContainer[int]
    goal: _containers.RepeatedScalarFieldContainer[int]
    action: _containers.RepeatedScalarFieldContainer[int]
    moved: _containers.RepeatedCompositeFieldContainer[MovedNumber]
    position: _containers.RepeatedScalarFieldContainer[int]
    plane: float
    whole_scene: bool
    def __init__(self, observation: _Optional[_Iterable[int]] = ..., goal: _Optional[_Iterable[int]] = ..., action: _Optional[_Iterable[int]] = ..., moved: _Optional[_Iterable[_Union[MovedNumber, _Mapping]]] = ..., position: _Optional[_Iterable[int]] = ..., plane: _Optional[float] = ..., whole_scene: bool = ...) -> None: ...

class MovedNumber(_message.Message):
    __slots__ = ("to",)
    TO_FIELD_NUMBER: _ClassVar[int]
    FROM_FIELD_NUMBER: _ClassVar[int]
    to: int
    def __init__(self, to: _Optional[int] = ..., **kwargs) -> None: ...

class TaskManipulation(_message.Message):
    __slots__ = ("shared_object", "one_arm_task", "success_steps", "arms")
    SHARED_OBJECT_FIELD_NUMBER: _ClassVar[int]
    ONE_ARM_TASK_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_STEPS_FIELD_NUMBER: _ClassVar[int]
    ARMS_FIELD_NUMBER: _ClassVar[int]
    shared_object: bool
    one_arm_task: str
    success_steps: int
    arms: _containers.RepeatedCompositeFieldContainer[ArmManipulation]
    def __init__(self, shared_object: bool = ..., one_arm_task: _Optional[str] = ..., success_steps: _Optional[int] = ..., arms: _Optional[_Iterable[_Union[ArmManipulation, _Mapping]]] = ...) -> None: ...

class ArmManipulation(_message.Message):
    __slots__ = ("gripper", "holding", "conditions")
    GRIPPER_FIELD_NUMBER: _ClassVar[int]
    HOLDING_FIELD_NUMBER: _ClassVar[int]
    CONDITIONS_FIELD_NUMBER: _ClassVar[int]
    gripper: int
    holding: _containers.RepeatedCompositeFieldContainer[Condition]
    conditions: _containers.RepeatedCompositeFieldContainer[Condition]
    def __init__(self, gripper: _Optional[int] = ..., holding: _Optional[_Iterable[_Union[Condition, _Mapping]]] = ..., conditions: _Optional[_Iterable[_Union[Condition, _Mapping]]] = ...) -> None: ...

class Condition(_message.Message):
    __slots__ = ("numbers", "target", "tolerance")
    NUMBERS_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    TOLERANCE_FIELD_NUMBER: _ClassVar[int]
    numbers: _containers.RepeatedScalarFieldContainer[int]
    target: _containers.RepeatedScalarFieldContainer[float]
    tolerance: float
    def __init__(self, numbers: _Optional[_Iterable[int]] = ..., target: _Optional[_Iterable[float]] = ..., tolerance: _Optional[float] = ...) -> None: ...

class TaskArm(_message.Message):
    __slots__ = ("observation", "goal", "action", "position", "lateral", "hand")
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    GOAL_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    LATERAL_FIELD_NUMBER: _ClassVar[int]
    HAND_FIELD_NUMBER: _ClassVar[int]
    observation: _containers.RepeatedScalarFieldContainer[int]
    goal: _containers.RepeatedScalarFieldContainer[int]
    action: _containers.RepeatedScalarFieldContainer[int]
    position: _containers.RepeatedScalarFieldContainer[int]
    lateral: _containers.RepeatedScalarFieldContainer[int]
    hand: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, observation: _Optional[_Iterable[int]] = ..., goal: _Optional[_Iterable[int]] = ..., action: _Optional[_Iterable[int]] = ..., position: _Optional[_Iterable[int]] = ..., lateral: _Optional[_Iterable[int]] = ..., hand: _Optional[_Iterable[int]] = ...) -> None: ...
