from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class BridgePhase(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    BRIDGE_PHASE_UNSPECIFIED: _ClassVar[BridgePhase]
    BRIDGE_PHASE_STOPPED: _ClassVar[BridgePhase]
    BRIDGE_PHASE_IDLE: _ClassVar[BridgePhase]
    BRIDGE_PHASE_MOVING: _ClassVar[BridgePhase]
    BRIDGE_PHASE_HOLDING: _ClassVar[BridgePhase]
    BRIDGE_PHASE_SETTLING: _ClassVar[BridgePhase]

class InjectedFault(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    INJECTED_FAULT_UNSPECIFIED: _ClassVar[InjectedFault]
    INJECTED_FAULT_EMERGENCY_STOP: _ClassVar[InjectedFault]
    INJECTED_FAULT_DRIVE_FAULT: _ClassVar[InjectedFault]
    INJECTED_FAULT_CONTACT: _ClassVar[InjectedFault]
    INJECTED_FAULT_BLOCKED_JOINT: _ClassVar[InjectedFault]
    INJECTED_FAULT_TORQUE: _ClassVar[InjectedFault]
    INJECTED_FAULT_DRIFT: _ClassVar[InjectedFault]
    INJECTED_FAULT_LATE_STATES: _ClassVar[InjectedFault]
BRIDGE_PHASE_UNSPECIFIED: BridgePhase
BRIDGE_PHASE_STOPPED: BridgePhase
BRIDGE_PHASE_IDLE: BridgePhase
BRIDGE_PHASE_MOVING: BridgePhase
BRIDGE_PHASE_HOLDING: BridgePhase
BRIDGE_PHASE_SETTLING: BridgePhase
INJECTED_FAULT_UNSPECIFIED: InjectedFault
INJECTED_FAULT_EMERGENCY_STOP: InjectedFault
INJECTED_FAULT_DRIVE_FAULT: InjectedFault
INJECTED_FAULT_CONTACT: InjectedFault
INJECTED_FAULT_BLOCKED_JOINT: InjectedFault
INJECTED_FAULT_TORQUE: InjectedFault
INJECTED_FAULT_DRIFT: InjectedFault
INJECTED_FAULT_LATE_STATES: InjectedFault

class DescribeBridgeRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class DescribeBridgeResponse(_message.Message):
    __slots__ = ("driver", "version", "period_s", "arms", "table_z_m", "task_frame", "limits", "cell_file")
    DRIVER_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    PERIOD_S_FIELD_NUMBER: _ClassVar[int]
    ARMS_FIELD_NUMBER: _ClassVar[int]
    TABLE_Z_M_FIELD_NUMBER: _ClassVar[int]
    TASK_FRAME_FIELD_NUMBER: _ClassVar[int]
    LIMITS_FIELD_NUMBER: _ClassVar[int]
    CELL_FILE_FIELD_NUMBER: _ClassVar[int]
    driver: str
    version: str
    period_s: float
    arms: _containers.RepeatedCompositeFieldContainer[ArmDescription]
    table_z_m: float
    task_frame: TaskFrameDescription
    limits: BridgeLimits
    cell_file: str
    def __init__(self, driver: _Optional[str] = ..., version: _Optional[str] = ..., period_s: _Optional[float] = ..., arms: _Optional[_Iterable[_Union[ArmDescription, _Mapping]]] = ..., table_z_m: _Optional[float] = ..., task_frame: _Optional[_Union[TaskFrameDescription, _Mapping]] = ..., limits: _Optional[_Union[BridgeLimits, _Mapping]] = ..., cell_file: _Optional[str] = ...) -> None: ...

class ArmDescription(_message.Message):
    __slots__ = ("model", "base_in_world_m", "yaw_rad", "joints", "name", "lag_s", "reaction_s", "brake_s", "is_measured")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    BASE_IN_WORLD_M_FIELD_NUMBER: _ClassVar[int]
    YAW_RAD_FIELD_NUMBER: _ClassVar[int]
    JOINTS_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    LAG_S_FIELD_NUMBER: _ClassVar[int]
    REACTION_S_FIELD_NUMBER: _ClassVar[int]
    BRAKE_S_FIELD_NUMBER: _ClassVar[int]
    IS_MEASURED_FIELD_NUMBER: _ClassVar[int]
    model: str
    base_in_world_m: _containers.RepeatedScalarFieldContainer[float]
    yaw_rad: float
    joints: _containers.RepeatedCompositeFieldContainer[JointDescription]
    name: str
    lag_s: float
    reaction_s: float
    brake_s: float
    is_measured: bool
    def __init__(self, model: _Optional[str] = ..., base_in_world_m: _Optional[_Iterable[float]] = ..., yaw_rad: _Optional[float] = ..., joints: _Optional[_Iterable[_Union[JointDescription, _Mapping]]] = ..., name: _Optional[str] = ..., lag_s: _Optional[float] = ..., reaction_s: _Optional[float] = ..., brake_s: _Optional[float] = ..., is_measured: bool = ...) -> None: ...

class JointDescription(_message.Message):
    __slots__ = ("low_rad", "high_rad", "speed_radps", "continuous")
    LOW_RAD_FIELD_NUMBER: _ClassVar[int]
    HIGH_RAD_FIELD_NUMBER: _ClassVar[int]
    SPEED_RADPS_FIELD_NUMBER: _ClassVar[int]
    CONTINUOUS_FIELD_NUMBER: _ClassVar[int]
    low_rad: float
    high_rad: float
    speed_radps: float
    continuous: bool
    def __init__(self, low_rad: _Optional[float] = ..., high_rad: _Optional[float] = ..., speed_radps: _Optional[float] = ..., continuous: bool = ...) -> None: ...

class TaskFrameDescription(_message.Message):
    __slots__ = ("scale", "centre_m", "lift_m")
    SCALE_FIELD_NUMBER: _ClassVar[int]
    CENTRE_M_FIELD_NUMBER: _ClassVar[int]
    LIFT_M_FIELD_NUMBER: _ClassVar[int]
    scale: float
    centre_m: float
    lift_m: float
    def __init__(self, scale: _Optional[float] = ..., centre_m: _Optional[float] = ..., lift_m: _Optional[float] = ...) -> None: ...

class BridgeLimits(_message.Message):
    __slots__ = ("speed", "tool_speed_mps", "ramp_s", "opening_per_s", "tilt_rad", "reach_share", "check_table_gap_m", "check_arms_gap_m", "table_gap_m", "arms_gap_m", "range_margin_rad", "start_rad", "duration_s", "tracking_rad", "torque_nm", "owner_hold_s", "owner_stop_s", "lease_s", "max_way_points", "max_step_m", "check_self_gap_m", "self_gap_m", "lag_s", "reaction_s", "brake_s")
    SPEED_FIELD_NUMBER: _ClassVar[int]
    TOOL_SPEED_MPS_FIELD_NUMBER: _ClassVar[int]
    RAMP_S_FIELD_NUMBER: _ClassVar[int]
    OPENING_PER_S_FIELD_NUMBER: _ClassVar[int]
    TILT_RAD_FIELD_NUMBER: _ClassVar[int]
    REACH_SHARE_FIELD_NUMBER: _ClassVar[int]
    CHECK_TABLE_GAP_M_FIELD_NUMBER: _ClassVar[int]
    CHECK_ARMS_GAP_M_FIELD_NUMBER: _ClassVar[int]
    TABLE_GAP_M_FIELD_NUMBER: _ClassVar[int]
    ARMS_GAP_M_FIELD_NUMBER: _ClassVar[int]
    RANGE_MARGIN_RAD_FIELD_NUMBER: _ClassVar[int]
    START_RAD_FIELD_NUMBER: _ClassVar[int]
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    TRACKING_RAD_FIELD_NUMBER: _ClassVar[int]
    TORQUE_NM_FIELD_NUMBER: _ClassVar[int]
    OWNER_HOLD_S_FIELD_NUMBER: _ClassVar[int]
    OWNER_STOP_S_FIELD_NUMBER: _ClassVar[int]
    LEASE_S_FIELD_NUMBER: _ClassVar[int]
    MAX_WAY_POINTS_FIELD_NUMBER: _ClassVar[int]
    MAX_STEP_M_FIELD_NUMBER: _ClassVar[int]
    CHECK_SELF_GAP_M_FIELD_NUMBER: _ClassVar[int]
    SELF_GAP_M_FIELD_NUMBER: _ClassVar[int]
    LAG_S_FIELD_NUMBER: _ClassVar[int]
    REACTION_S_FIELD_NUMBER: _ClassVar[int]
    BRAKE_S_FIELD_NUMBER: _ClassVar[int]
    speed: float
    tool_speed_mps: float
    ramp_s: float
    opening_per_s: float
    tilt_rad: float
    reach_share: float
    check_table_gap_m: float
    check_arms_gap_m: float
    table_gap_m: float
    arms_gap_m: float
    range_margin_rad: float
    start_rad: float
    duration_s: float
    tracking_rad: float
    torque_nm: float
    owner_hold_s: float
    owner_stop_s: float
    lease_s: float
    max_way_points: int
    max_step_m: float
    check_self_gap_m: float
    self_gap_m: float
    lag_s: float
    reaction_s: float
    brake_s: float
    def __init__(self, speed: _Optional[float] = ..., tool_speed_mps: _Optional[float] = ..., ramp_s: _Optional[float] = ..., opening_per_s: _Optional[float] = ..., tilt_rad: _Optional[float] = ..., reach_share: _Optional[float] = ..., check_table_gap_m: _Optional[float] = ..., check_arms_gap_m: _Optional[float] = ..., table_gap_m: _Optional[float] = ..., arms_gap_m: _Optional[float] = ..., range_margin_rad: _Optional[float] = ..., start_rad: _Optional[float] = ..., duration_s: _Optional[float] = ..., tracking_rad: _Optional[float] = ..., torque_nm: _Optional[float] = ..., owner_hold_s: _Optional[float] = ..., owner_stop_s: _Optional[float] = ..., lease_s: _Optional[float] = ..., max_way_points: _Optional[int] = ..., max_step_m: _Optional[float] = ..., check_self_gap_m: _Optional[float] = ..., self_gap_m: _Optional[float] = ..., lag_s: _Optional[float] = ..., reaction_s: _Optional[float] = ..., brake_s: _Optional[float] = ...) -> None: ...

class AcquireRequest(_message.Message):
    __slots__ = ("token",)
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    token: str
    def __init__(self, token: _Optional[str] = ...) -> None: ...

class AcquireResponse(_message.Message):
    __slots__ = ("token", "lease_s")
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    LEASE_S_FIELD_NUMBER: _ClassVar[int]
    token: str
    lease_s: float
    def __init__(self, token: _Optional[str] = ..., lease_s: _Optional[float] = ...) -> None: ...

class ReleaseRequest(_message.Message):
    __slots__ = ("token",)
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    token: str
    def __init__(self, token: _Optional[str] = ...) -> None: ...

class ReleaseResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ResetRequest(_message.Message):
    __slots__ = ("token",)
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    token: str
    def __init__(self, token: _Optional[str] = ...) -> None: ...

class ResetResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class MotionRequest(_message.Message):
    __slots__ = ("way_points", "joint_motion", "speed")
    WAY_POINTS_FIELD_NUMBER: _ClassVar[int]
    JOINT_MOTION_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    way_points: WayPoints
    joint_motion: JointMotion
    speed: float
    def __init__(self, way_points: _Optional[_Union[WayPoints, _Mapping]] = ..., joint_motion: _Optional[_Union[JointMotion, _Mapping]] = ..., speed: _Optional[float] = ...) -> None: ...

class WayPoints(_message.Message):
    __slots__ = ("way_points", "step_s", "from_here")
    WAY_POINTS_FIELD_NUMBER: _ClassVar[int]
    STEP_S_FIELD_NUMBER: _ClassVar[int]
    FROM_HERE_FIELD_NUMBER: _ClassVar[int]
    way_points: _containers.RepeatedCompositeFieldContainer[BridgeWayPoint]
    step_s: float
    from_here: bool
    def __init__(self, way_points: _Optional[_Iterable[_Union[BridgeWayPoint, _Mapping]]] = ..., step_s: _Optional[float] = ..., from_here: bool = ...) -> None: ...

class BridgeWayPoint(_message.Message):
    __slots__ = ("arms",)
    ARMS_FIELD_NUMBER: _ClassVar[int]
    arms: _containers.RepeatedCompositeFieldContainer[ArmWayPoint]
    def __init__(self, arms: _Optional[_Iterable[_Union[ArmWayPoint, _Mapping]]] = ...) -> None: ...

class ArmWayPoint(_message.Message):
    __slots__ = ("tool_in_world_m", "opening")
    TOOL_IN_WORLD_M_FIELD_NUMBER: _ClassVar[int]
    OPENING_FIELD_NUMBER: _ClassVar[int]
    tool_in_world_m: _containers.RepeatedScalarFieldContainer[float]
    opening: float
    def __init__(self, tool_in_world_m: _Optional[_Iterable[float]] = ..., opening: _Optional[float] = ...) -> None: ...

class JointMotion(_message.Message):
    __slots__ = ("period_s", "arms")
    PERIOD_S_FIELD_NUMBER: _ClassVar[int]
    ARMS_FIELD_NUMBER: _ClassVar[int]
    period_s: float
    arms: _containers.RepeatedCompositeFieldContainer[ArmMotion]
    def __init__(self, period_s: _Optional[float] = ..., arms: _Optional[_Iterable[_Union[ArmMotion, _Mapping]]] = ...) -> None: ...

class ArmMotion(_message.Message):
    __slots__ = ("samples",)
    SAMPLES_FIELD_NUMBER: _ClassVar[int]
    samples: _containers.RepeatedCompositeFieldContainer[JointSample]
    def __init__(self, samples: _Optional[_Iterable[_Union[JointSample, _Mapping]]] = ...) -> None: ...

class JointSample(_message.Message):
    __slots__ = ("angles_rad", "velocities_radps", "opening")
    ANGLES_RAD_FIELD_NUMBER: _ClassVar[int]
    VELOCITIES_RADPS_FIELD_NUMBER: _ClassVar[int]
    OPENING_FIELD_NUMBER: _ClassVar[int]
    angles_rad: _containers.RepeatedScalarFieldContainer[float]
    velocities_radps: _containers.RepeatedScalarFieldContainer[float]
    opening: float
    def __init__(self, angles_rad: _Optional[_Iterable[float]] = ..., velocities_radps: _Optional[_Iterable[float]] = ..., opening: _Optional[float] = ...) -> None: ...

class CheckRequest(_message.Message):
    __slots__ = ("motion",)
    MOTION_FIELD_NUMBER: _ClassVar[int]
    motion: MotionRequest
    def __init__(self, motion: _Optional[_Union[MotionRequest, _Mapping]] = ...) -> None: ...

class CheckResponse(_message.Message):
    __slots__ = ("accepted", "refused")
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    accepted: AcceptedMotion
    refused: MotionRefusal
    def __init__(self, accepted: _Optional[_Union[AcceptedMotion, _Mapping]] = ..., refused: _Optional[_Union[MotionRefusal, _Mapping]] = ...) -> None: ...

class AcceptedMotion(_message.Message):
    __slots__ = ("duration_s", "speed", "table_gap_m", "arms_gap_m", "self_gap_m")
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    TABLE_GAP_M_FIELD_NUMBER: _ClassVar[int]
    ARMS_GAP_M_FIELD_NUMBER: _ClassVar[int]
    SELF_GAP_M_FIELD_NUMBER: _ClassVar[int]
    duration_s: float
    speed: float
    table_gap_m: _containers.RepeatedScalarFieldContainer[float]
    arms_gap_m: float
    self_gap_m: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, duration_s: _Optional[float] = ..., speed: _Optional[float] = ..., table_gap_m: _Optional[_Iterable[float]] = ..., arms_gap_m: _Optional[float] = ..., self_gap_m: _Optional[_Iterable[float]] = ...) -> None: ...

class MotionRefusal(_message.Message):
    __slots__ = ("name", "sentence", "when_s", "arm", "joint", "way_point", "got", "allowed", "unit")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SENTENCE_FIELD_NUMBER: _ClassVar[int]
    WHEN_S_FIELD_NUMBER: _ClassVar[int]
    ARM_FIELD_NUMBER: _ClassVar[int]
    JOINT_FIELD_NUMBER: _ClassVar[int]
    WAY_POINT_FIELD_NUMBER: _ClassVar[int]
    GOT_FIELD_NUMBER: _ClassVar[int]
    ALLOWED_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    name: str
    sentence: str
    when_s: float
    arm: int
    joint: int
    way_point: int
    got: float
    allowed: float
    unit: str
    def __init__(self, name: _Optional[str] = ..., sentence: _Optional[str] = ..., when_s: _Optional[float] = ..., arm: _Optional[int] = ..., joint: _Optional[int] = ..., way_point: _Optional[int] = ..., got: _Optional[float] = ..., allowed: _Optional[float] = ..., unit: _Optional[str] = ...) -> None: ...

class ExecuteRequest(_message.Message):
    __slots__ = ("start", "alive")
    START_FIELD_NUMBER: _ClassVar[int]
    ALIVE_FIELD_NUMBER: _ClassVar[int]
    start: ExecuteStart
    alive: SignOfLife
    def __init__(self, start: _Optional[_Union[ExecuteStart, _Mapping]] = ..., alive: _Optional[_Union[SignOfLife, _Mapping]] = ...) -> None: ...

class ExecuteStart(_message.Message):
    __slots__ = ("token", "motion", "name")
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    token: str
    motion: MotionRequest
    name: str
    def __init__(self, token: _Optional[str] = ..., motion: _Optional[_Union[MotionRequest, _Mapping]] = ..., name: _Optional[str] = ...) -> None: ...

class SignOfLife(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ExecuteResponse(_message.Message):
    __slots__ = ("progress", "outcome")
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    progress: MotionProgress
    outcome: MotionOutcome
    def __init__(self, progress: _Optional[_Union[MotionProgress, _Mapping]] = ..., outcome: _Optional[_Union[MotionOutcome, _Mapping]] = ...) -> None: ...

class MotionProgress(_message.Message):
    __slots__ = ("phase", "played_s", "duration_s", "speed", "arms")
    PHASE_FIELD_NUMBER: _ClassVar[int]
    PLAYED_S_FIELD_NUMBER: _ClassVar[int]
    DURATION_S_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    ARMS_FIELD_NUMBER: _ClassVar[int]
    phase: BridgePhase
    played_s: float
    duration_s: float
    speed: float
    arms: _containers.RepeatedCompositeFieldContainer[ArmState]
    def __init__(self, phase: _Optional[_Union[BridgePhase, str]] = ..., played_s: _Optional[float] = ..., duration_s: _Optional[float] = ..., speed: _Optional[float] = ..., arms: _Optional[_Iterable[_Union[ArmState, _Mapping]]] = ...) -> None: ...

class ArmState(_message.Message):
    __slots__ = ("angles_rad", "velocities_radps", "tool_in_world_m", "opening", "reference_rad", "reference_tool_in_world_m", "drive_fault", "contact", "emergency_stop")
    ANGLES_RAD_FIELD_NUMBER: _ClassVar[int]
    VELOCITIES_RADPS_FIELD_NUMBER: _ClassVar[int]
    TOOL_IN_WORLD_M_FIELD_NUMBER: _ClassVar[int]
    OPENING_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_RAD_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_TOOL_IN_WORLD_M_FIELD_NUMBER: _ClassVar[int]
    DRIVE_FAULT_FIELD_NUMBER: _ClassVar[int]
    CONTACT_FIELD_NUMBER: _ClassVar[int]
    EMERGENCY_STOP_FIELD_NUMBER: _ClassVar[int]
    angles_rad: _containers.RepeatedScalarFieldContainer[float]
    velocities_radps: _containers.RepeatedScalarFieldContainer[float]
    tool_in_world_m: _containers.RepeatedScalarFieldContainer[float]
    opening: float
    reference_rad: _containers.RepeatedScalarFieldContainer[float]
    reference_tool_in_world_m: _containers.RepeatedScalarFieldContainer[float]
    drive_fault: bool
    contact: bool
    emergency_stop: bool
    def __init__(self, angles_rad: _Optional[_Iterable[float]] = ..., velocities_radps: _Optional[_Iterable[float]] = ..., tool_in_world_m: _Optional[_Iterable[float]] = ..., opening: _Optional[float] = ..., reference_rad: _Optional[_Iterable[float]] = ..., reference_tool_in_world_m: _Optional[_Iterable[float]] = ..., drive_fault: bool = ..., contact: bool = ..., emergency_stop: bool = ...) -> None: ...

class MotionOutcome(_message.Message):
    __slots__ = ("done", "stopped")
    DONE_FIELD_NUMBER: _ClassVar[int]
    STOPPED_FIELD_NUMBER: _ClassVar[int]
    done: MotionDone
    stopped: BridgeStop
    def __init__(self, done: _Optional[_Union[MotionDone, _Mapping]] = ..., stopped: _Optional[_Union[BridgeStop, _Mapping]] = ...) -> None: ...

class MotionDone(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class BridgeStop(_message.Message):
    __slots__ = ("name", "sentence", "when_s", "arm", "joint", "got", "allowed", "unit")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SENTENCE_FIELD_NUMBER: _ClassVar[int]
    WHEN_S_FIELD_NUMBER: _ClassVar[int]
    ARM_FIELD_NUMBER: _ClassVar[int]
    JOINT_FIELD_NUMBER: _ClassVar[int]
    GOT_FIELD_NUMBER: _ClassVar[int]
    ALLOWED_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    name: str
    sentence: str
    when_s: float
    arm: int
    joint: int
    got: float
    allowed: float
    unit: str
    def __init__(self, name: _Optional[str] = ..., sentence: _Optional[str] = ..., when_s: _Optional[float] = ..., arm: _Optional[int] = ..., joint: _Optional[int] = ..., got: _Optional[float] = ..., allowed: _Optional[float] = ..., unit: _Optional[str] = ...) -> None: ...

class StopRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class StopResponse(_message.Message):
    __slots__ = ("stopped",)
    STOPPED_FIELD_NUMBER: _ClassVar[int]
    stopped: BridgeStop
    def __init__(self, stopped: _Optional[_Union[BridgeStop, _Mapping]] = ...) -> None: ...

class BridgeStatusRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class BridgeStatusResponse(_message.Message):
    __slots__ = ("phase", "stopped", "is_owned", "lease_left_s", "at_rest", "arms", "motion", "now_s", "since_tick_s", "injected")
    PHASE_FIELD_NUMBER: _ClassVar[int]
    STOPPED_FIELD_NUMBER: _ClassVar[int]
    IS_OWNED_FIELD_NUMBER: _ClassVar[int]
    LEASE_LEFT_S_FIELD_NUMBER: _ClassVar[int]
    AT_REST_FIELD_NUMBER: _ClassVar[int]
    ARMS_FIELD_NUMBER: _ClassVar[int]
    MOTION_FIELD_NUMBER: _ClassVar[int]
    NOW_S_FIELD_NUMBER: _ClassVar[int]
    SINCE_TICK_S_FIELD_NUMBER: _ClassVar[int]
    INJECTED_FIELD_NUMBER: _ClassVar[int]
    phase: BridgePhase
    stopped: BridgeStop
    is_owned: bool
    lease_left_s: float
    at_rest: bool
    arms: _containers.RepeatedCompositeFieldContainer[ArmState]
    motion: MotionProgress
    now_s: float
    since_tick_s: float
    injected: _containers.RepeatedCompositeFieldContainer[FaultInjection]
    def __init__(self, phase: _Optional[_Union[BridgePhase, str]] = ..., stopped: _Optional[_Union[BridgeStop, _Mapping]] = ..., is_owned: bool = ..., lease_left_s: _Optional[float] = ..., at_rest: bool = ..., arms: _Optional[_Iterable[_Union[ArmState, _Mapping]]] = ..., motion: _Optional[_Union[MotionProgress, _Mapping]] = ..., now_s: _Optional[float] = ..., since_tick_s: _Optional[float] = ..., injected: _Optional[_Iterable[_Union[FaultInjection, _Mapping]]] = ...) -> None: ...

class InjectRequest(_message.Message):
    __slots__ = ("fault", "clear")
    FAULT_FIELD_NUMBER: _ClassVar[int]
    CLEAR_FIELD_NUMBER: _ClassVar[int]
    fault: FaultInjection
    clear: ClearFaults
    def __init__(self, fault: _Optional[_Union[FaultInjection, _Mapping]] = ..., clear: _Optional[_Union[ClearFaults, _Mapping]] = ...) -> None: ...

class InjectResponse(_message.Message):
    __slots__ = ("injected",)
    INJECTED_FIELD_NUMBER: _ClassVar[int]
    injected: _containers.RepeatedCompositeFieldContainer[FaultInjection]
    def __init__(self, injected: _Optional[_Iterable[_Union[FaultInjection, _Mapping]]] = ...) -> None: ...

class ClearFaults(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class FaultInjection(_message.Message):
    __slots__ = ("fault", "arm", "joint")
    FAULT_FIELD_NUMBER: _ClassVar[int]
    ARM_FIELD_NUMBER: _ClassVar[int]
    JOINT_FIELD_NUMBER: _ClassVar[int]
    fault: InjectedFault
    arm: int
    joint: int
    def __init__(self, fault: _Optional[_Union[InjectedFault, str]] = ..., arm: _Optional[int] = ..., joint: _Optional[int] = ...) -> None: ...
