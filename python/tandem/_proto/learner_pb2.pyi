from . import task_pb2 as _task_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class EpisodeKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    EPISODE_KIND_UNSPECIFIED: _ClassVar[EpisodeKind]
    EPISODE_KIND_TRAINING: _ClassVar[EpisodeKind]
    EPISODE_KIND_EVALUATION: _ClassVar[EpisodeKind]
EPISODE_KIND_UNSPECIFIED: EpisodeKind
EPISODE_KIND_TRAINING: EpisodeKind
EPISODE_KIND_EVALUATION: EpisodeKind

class JoinRequest(_message.Message):
    __slots__ = ("worker", "version")
    WORKER_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    worker: str
    version: str
    def __init__(self, worker: _Optional[str] = ..., version: _Optional[str] = ...) -> None: ...

class JoinResponse(_message.Message):
    __slots__ = ("worker_id", "terms", "learner")
    WORKER_ID_FIELD_NUMBER: _ClassVar[int]
    TERMS_FIELD_NUMBER: _ClassVar[int]
    LEARNER_FIELD_NUMBER: _ClassVar[int]
    worker_id: int
    terms: RunTerms
    learner: int
    def __init__(self, worker_id: _Optional[int] = ..., terms: _Optional[_Union[RunTerms, _Mapping]] = ..., learner: _Optional[int] = ...) -> None: ...

class RunTerms(_message.Message):
    __slots__ = ("task", "n_arms", "account", "exploration", "world", "run", "description", "advice", "symmetrized_evaluation")
    TASK_FIELD_NUMBER: _ClassVar[int]
    N_ARMS_FIELD_NUMBER: _ClassVar[int]
    ACCOUNT_FIELD_NUMBER: _ClassVar[int]
    EXPLORATION_FIELD_NUMBER: _ClassVar[int]
    WORLD_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTION_FIELD_NUMBER: _ClassVar[int]
    ADVICE_FIELD_NUMBER: _ClassVar[int]
    SYMMETRIZED_EVALUATION_FIELD_NUMBER: _ClassVar[int]
    task: str
    n_arms: int
    account: str
    exploration: Exploration
    world: WorldTerms
    run: str
    description: _task_pb2.TaskDescription
    advice: AdviceTerms
    symmetrized_evaluation: bool
    def __init__(self, task: _Optional[str] = ..., n_arms: _Optional[int] = ..., account: _Optional[str] = ..., exploration: _Optional[_Union[Exploration, _Mapping]] = ..., world: _Optional[_Union[WorldTerms, _Mapping]] = ..., run: _Optional[str] = ..., description: _Optional[_Union[_task_pb2.TaskDescription, _Mapping]] = ..., advice: _Optional[_Union[AdviceTerms, _Mapping]] = ..., symmetrized_evaluation: bool = ...) -> None: ...

class AdviceTerms(_message.Message):
    __slots__ = ("judges_policy_action", "charges_slot_steps")
    JUDGES_POLICY_ACTION_FIELD_NUMBER: _ClassVar[int]
    CHARGES_SLOT_STEPS_FIELD_NUMBER: _ClassVar[int]
    judges_policy_action: bool
    charges_slot_steps: bool
    def __init__(self, judges_policy_action: bool = ..., charges_slot_steps: bool = ...) -> None: ...

class Exploration(_message.Message):
    __slots__ = ("noise_std", "random_share", "random_hold_mean_steps", "joint_random_actions")
    NOISE_STD_FIELD_NUMBER: _ClassVar[int]
    RANDOM_SHARE_FIELD_NUMBER: _ClassVar[int]
    RANDOM_HOLD_MEAN_STEPS_FIELD_NUMBER: _ClassVar[int]
    JOINT_RANDOM_ACTIONS_FIELD_NUMBER: _ClassVar[int]
    noise_std: float
    random_share: float
    random_hold_mean_steps: float
    joint_random_actions: bool
    def __init__(self, noise_std: _Optional[float] = ..., random_share: _Optional[float] = ..., random_hold_mean_steps: _Optional[float] = ..., joint_random_actions: bool = ...) -> None: ...

class WorldTerms(_message.Message):
    __slots__ = ("gripped_start_share", "wide_start_share", "substeps", "randomization", "gripped_start_env_steps")
    GRIPPED_START_SHARE_FIELD_NUMBER: _ClassVar[int]
    WIDE_START_SHARE_FIELD_NUMBER: _ClassVar[int]
    SUBSTEPS_FIELD_NUMBER: _ClassVar[int]
    RANDOMIZATION_FIELD_NUMBER: _ClassVar[int]
    GRIPPED_START_ENV_STEPS_FIELD_NUMBER: _ClassVar[int]
    gripped_start_share: float
    wide_start_share: float
    substeps: int
    randomization: float
    gripped_start_env_steps: int
    def __init__(self, gripped_start_share: _Optional[float] = ..., wide_start_share: _Optional[float] = ..., substeps: _Optional[int] = ..., randomization: _Optional[float] = ..., gripped_start_env_steps: _Optional[int] = ...) -> None: ...

class NextWorkRequest(_message.Message):
    __slots__ = ("worker_id",)
    WORKER_ID_FIELD_NUMBER: _ClassVar[int]
    worker_id: int
    def __init__(self, worker_id: _Optional[int] = ...) -> None: ...

class NextWorkResponse(_message.Message):
    __slots__ = ("slot", "wait", "finished")
    SLOT_FIELD_NUMBER: _ClassVar[int]
    WAIT_FIELD_NUMBER: _ClassVar[int]
    FINISHED_FIELD_NUMBER: _ClassVar[int]
    slot: Slot
    wait: Wait
    finished: Finished
    def __init__(self, slot: _Optional[_Union[Slot, _Mapping]] = ..., wait: _Optional[_Union[Wait, _Mapping]] = ..., finished: _Optional[_Union[Finished, _Mapping]] = ...) -> None: ...

class Slot(_message.Message):
    __slots__ = ("slot", "parameter_version", "kind", "episodes")
    SLOT_FIELD_NUMBER: _ClassVar[int]
    PARAMETER_VERSION_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    slot: int
    parameter_version: int
    kind: EpisodeKind
    episodes: _containers.RepeatedCompositeFieldContainer[EpisodeOrder]
    def __init__(self, slot: _Optional[int] = ..., parameter_version: _Optional[int] = ..., kind: _Optional[_Union[EpisodeKind, str]] = ..., episodes: _Optional[_Iterable[_Union[EpisodeOrder, _Mapping]]] = ...) -> None: ...

class EpisodeOrder(_message.Message):
    __slots__ = ("number", "seed", "advised", "uniform", "record", "advised_steps", "greedy")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    ADVISED_FIELD_NUMBER: _ClassVar[int]
    UNIFORM_FIELD_NUMBER: _ClassVar[int]
    RECORD_FIELD_NUMBER: _ClassVar[int]
    ADVISED_STEPS_FIELD_NUMBER: _ClassVar[int]
    GREEDY_FIELD_NUMBER: _ClassVar[int]
    number: int
    seed: int
    advised: bool
    uniform: bool
    record: bool
    advised_steps: int
    greedy: bool
    def __init__(self, number: _Optional[int] = ..., seed: _Optional[int] = ..., advised: bool = ..., uniform: bool = ..., record: bool = ..., advised_steps: _Optional[int] = ..., greedy: bool = ...) -> None: ...

class Wait(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Finished(_message.Message):
    __slots__ = ("reason", "interrupted")
    REASON_FIELD_NUMBER: _ClassVar[int]
    INTERRUPTED_FIELD_NUMBER: _ClassVar[int]
    reason: str
    interrupted: bool
    def __init__(self, reason: _Optional[str] = ..., interrupted: bool = ...) -> None: ...

class GetParametersRequest(_message.Message):
    __slots__ = ("version",)
    VERSION_FIELD_NUMBER: _ClassVar[int]
    version: int
    def __init__(self, version: _Optional[int] = ...) -> None: ...

class Parameters(_message.Message):
    __slots__ = ("version", "n_hidden", "n_layers", "actor", "observation_mean", "observation_std", "goal_mean", "goal_std", "n_critics", "n_critic_hidden", "n_critic_layers", "n_critic_heads", "critics", "ask_above")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    N_HIDDEN_FIELD_NUMBER: _ClassVar[int]
    N_LAYERS_FIELD_NUMBER: _ClassVar[int]
    ACTOR_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_MEAN_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_STD_FIELD_NUMBER: _ClassVar[int]
    GOAL_MEAN_FIELD_NUMBER: _ClassVar[int]
    GOAL_STD_FIELD_NUMBER: _ClassVar[int]
    N_CRITICS_FIELD_NUMBER: _ClassVar[int]
    N_CRITIC_HIDDEN_FIELD_NUMBER: _ClassVar[int]
    N_CRITIC_LAYERS_FIELD_NUMBER: _ClassVar[int]
    N_CRITIC_HEADS_FIELD_NUMBER: _ClassVar[int]
    CRITICS_FIELD_NUMBER: _ClassVar[int]
    ASK_ABOVE_FIELD_NUMBER: _ClassVar[int]
    version: int
    n_hidden: int
    n_layers: int
    actor: bytes
    observation_mean: bytes
    observation_std: bytes
    goal_mean: bytes
    goal_std: bytes
    n_critics: int
    n_critic_hidden: int
    n_critic_layers: int
    n_critic_heads: int
    critics: bytes
    ask_above: float
    def __init__(self, version: _Optional[int] = ..., n_hidden: _Optional[int] = ..., n_layers: _Optional[int] = ..., actor: _Optional[bytes] = ..., observation_mean: _Optional[bytes] = ..., observation_std: _Optional[bytes] = ..., goal_mean: _Optional[bytes] = ..., goal_std: _Optional[bytes] = ..., n_critics: _Optional[int] = ..., n_critic_hidden: _Optional[int] = ..., n_critic_layers: _Optional[int] = ..., n_critic_heads: _Optional[int] = ..., critics: _Optional[bytes] = ..., ask_above: _Optional[float] = ...) -> None: ...

class SubmitEpisodesRequest(_message.Message):
    __slots__ = ("worker_id", "slot", "episodes", "environment_check")
    WORKER_ID_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    ENVIRONMENT_CHECK_FIELD_NUMBER: _ClassVar[int]
    worker_id: int
    slot: int
    episodes: _containers.RepeatedCompositeFieldContainer[Episode]
    environment_check: EnvironmentCheck
    def __init__(self, worker_id: _Optional[int] = ..., slot: _Optional[int] = ..., episodes: _Optional[_Iterable[_Union[Episode, _Mapping]]] = ..., environment_check: _Optional[_Union[EnvironmentCheck, _Mapping]] = ...) -> None: ...

class EnvironmentCheck(_message.Message):
    __slots__ = ("n_episodes", "difference", "failures", "failure")
    N_EPISODES_FIELD_NUMBER: _ClassVar[int]
    DIFFERENCE_FIELD_NUMBER: _ClassVar[int]
    FAILURES_FIELD_NUMBER: _ClassVar[int]
    FAILURE_FIELD_NUMBER: _ClassVar[int]
    n_episodes: int
    difference: str
    failures: int
    failure: str
    def __init__(self, n_episodes: _Optional[int] = ..., difference: _Optional[str] = ..., failures: _Optional[int] = ..., failure: _Optional[str] = ...) -> None: ...

class SubmitEpisodesResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Episode(_message.Message):
    __slots__ = ("number", "kind", "parameter_version", "observations", "goal", "actions", "advised_arms", "contacts", "advice_charged", "avoidance_steps", "queried_steps")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    PARAMETER_VERSION_FIELD_NUMBER: _ClassVar[int]
    OBSERVATIONS_FIELD_NUMBER: _ClassVar[int]
    GOAL_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    ADVISED_ARMS_FIELD_NUMBER: _ClassVar[int]
    CONTACTS_FIELD_NUMBER: _ClassVar[int]
    ADVICE_CHARGED_FIELD_NUMBER: _ClassVar[int]
    AVOIDANCE_STEPS_FIELD_NUMBER: _ClassVar[int]
    QUERIED_STEPS_FIELD_NUMBER: _ClassVar[int]
    number: int
    kind: EpisodeKind
    parameter_version: int
    observations: bytes
    goal: bytes
    actions: bytes
    advised_arms: bytes
    contacts: bytes
    advice_charged: int
    avoidance_steps: int
    queried_steps: int
    def __init__(self, number: _Optional[int] = ..., kind: _Optional[_Union[EpisodeKind, str]] = ..., parameter_version: _Optional[int] = ..., observations: _Optional[bytes] = ..., goal: _Optional[bytes] = ..., actions: _Optional[bytes] = ..., advised_arms: _Optional[bytes] = ..., contacts: _Optional[bytes] = ..., advice_charged: _Optional[int] = ..., avoidance_steps: _Optional[int] = ..., queried_steps: _Optional[int] = ...) -> None: ...

class StatusRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class WatchRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Progress(_message.Message):
    __slots__ = ("task", "n_arms", "strategy", "round", "env_steps", "episodes", "updates", "wall_s", "env_steps_per_s", "updates_per_s", "advice_spent", "budget_left", "phase", "training_success", "workers", "evaluation", "best", "ended", "end_reason", "digest", "warning", "environment", "advice_queries", "resumed_from_round", "max_env_steps", "max_minutes", "environment_failures")
    TASK_FIELD_NUMBER: _ClassVar[int]
    N_ARMS_FIELD_NUMBER: _ClassVar[int]
    STRATEGY_FIELD_NUMBER: _ClassVar[int]
    ROUND_FIELD_NUMBER: _ClassVar[int]
    ENV_STEPS_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    UPDATES_FIELD_NUMBER: _ClassVar[int]
    WALL_S_FIELD_NUMBER: _ClassVar[int]
    ENV_STEPS_PER_S_FIELD_NUMBER: _ClassVar[int]
    UPDATES_PER_S_FIELD_NUMBER: _ClassVar[int]
    ADVICE_SPENT_FIELD_NUMBER: _ClassVar[int]
    BUDGET_LEFT_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    TRAINING_SUCCESS_FIELD_NUMBER: _ClassVar[int]
    WORKERS_FIELD_NUMBER: _ClassVar[int]
    EVALUATION_FIELD_NUMBER: _ClassVar[int]
    BEST_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    END_REASON_FIELD_NUMBER: _ClassVar[int]
    DIGEST_FIELD_NUMBER: _ClassVar[int]
    WARNING_FIELD_NUMBER: _ClassVar[int]
    ENVIRONMENT_FIELD_NUMBER: _ClassVar[int]
    ADVICE_QUERIES_FIELD_NUMBER: _ClassVar[int]
    RESUMED_FROM_ROUND_FIELD_NUMBER: _ClassVar[int]
    MAX_ENV_STEPS_FIELD_NUMBER: _ClassVar[int]
    MAX_MINUTES_FIELD_NUMBER: _ClassVar[int]
    ENVIRONMENT_FAILURES_FIELD_NUMBER: _ClassVar[int]
    task: str
    n_arms: int
    strategy: str
    round: int
    env_steps: int
    episodes: int
    updates: int
    wall_s: float
    env_steps_per_s: float
    updates_per_s: float
    advice_spent: int
    budget_left: int
    phase: str
    training_success: float
    workers: _containers.RepeatedCompositeFieldContainer[WorkerProgress]
    evaluation: Evaluation
    best: Evaluation
    ended: bool
    end_reason: str
    digest: str
    warning: str
    environment: str
    advice_queries: int
    resumed_from_round: int
    max_env_steps: int
    max_minutes: float
    environment_failures: int
    def __init__(self, task: _Optional[str] = ..., n_arms: _Optional[int] = ..., strategy: _Optional[str] = ..., round: _Optional[int] = ..., env_steps: _Optional[int] = ..., episodes: _Optional[int] = ..., updates: _Optional[int] = ..., wall_s: _Optional[float] = ..., env_steps_per_s: _Optional[float] = ..., updates_per_s: _Optional[float] = ..., advice_spent: _Optional[int] = ..., budget_left: _Optional[int] = ..., phase: _Optional[str] = ..., training_success: _Optional[float] = ..., workers: _Optional[_Iterable[_Union[WorkerProgress, _Mapping]]] = ..., evaluation: _Optional[_Union[Evaluation, _Mapping]] = ..., best: _Optional[_Union[Evaluation, _Mapping]] = ..., ended: bool = ..., end_reason: _Optional[str] = ..., digest: _Optional[str] = ..., warning: _Optional[str] = ..., environment: _Optional[str] = ..., advice_queries: _Optional[int] = ..., resumed_from_round: _Optional[int] = ..., max_env_steps: _Optional[int] = ..., max_minutes: _Optional[float] = ..., environment_failures: _Optional[int] = ...) -> None: ...

class WorkerProgress(_message.Message):
    __slots__ = ("worker_id", "name", "episodes", "doing")
    WORKER_ID_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    DOING_FIELD_NUMBER: _ClassVar[int]
    worker_id: int
    name: str
    episodes: int
    doing: str
    def __init__(self, worker_id: _Optional[int] = ..., name: _Optional[str] = ..., episodes: _Optional[int] = ..., doing: _Optional[str] = ...) -> None: ...

class Evaluation(_message.Message):
    __slots__ = ("round", "env_steps", "n_episodes", "success", "success_low", "success_high", "success_joint", "success_per_arm", "collision_rate", "mean_q", "success_without_contact", "success_without_contact_low", "success_without_contact_high", "arm_contact_rate", "table_contact_rate", "avoidance_rate")
    ROUND_FIELD_NUMBER: _ClassVar[int]
    ENV_STEPS_FIELD_NUMBER: _ClassVar[int]
    N_EPISODES_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_LOW_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_HIGH_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_JOINT_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_PER_ARM_FIELD_NUMBER: _ClassVar[int]
    COLLISION_RATE_FIELD_NUMBER: _ClassVar[int]
    MEAN_Q_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_WITHOUT_CONTACT_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_WITHOUT_CONTACT_LOW_FIELD_NUMBER: _ClassVar[int]
    SUCCESS_WITHOUT_CONTACT_HIGH_FIELD_NUMBER: _ClassVar[int]
    ARM_CONTACT_RATE_FIELD_NUMBER: _ClassVar[int]
    TABLE_CONTACT_RATE_FIELD_NUMBER: _ClassVar[int]
    AVOIDANCE_RATE_FIELD_NUMBER: _ClassVar[int]
    round: int
    env_steps: int
    n_episodes: int
    success: float
    success_low: float
    success_high: float
    success_joint: float
    success_per_arm: _containers.RepeatedScalarFieldContainer[float]
    collision_rate: float
    mean_q: float
    success_without_contact: float
    success_without_contact_low: float
    success_without_contact_high: float
    arm_contact_rate: float
    table_contact_rate: float
    avoidance_rate: float
    def __init__(self, round: _Optional[int] = ..., env_steps: _Optional[int] = ..., n_episodes: _Optional[int] = ..., success: _Optional[float] = ..., success_low: _Optional[float] = ..., success_high: _Optional[float] = ..., success_joint: _Optional[float] = ..., success_per_arm: _Optional[_Iterable[float]] = ..., collision_rate: _Optional[float] = ..., mean_q: _Optional[float] = ..., success_without_contact: _Optional[float] = ..., success_without_contact_low: _Optional[float] = ..., success_without_contact_high: _Optional[float] = ..., arm_contact_rate: _Optional[float] = ..., table_contact_rate: _Optional[float] = ..., avoidance_rate: _Optional[float] = ...) -> None: ...
