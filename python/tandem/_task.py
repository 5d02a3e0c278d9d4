"""Descriptions of tasks."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from tandem import _native
from tandem._grpc import ServiceError
from tandem._proto import task_pb2

if TYPE_CHECKING:
    from tandem.policy import Policy

Floats = NDArray[np.float32]
Norm = Literal["euclidean", "maximum"]


@dataclasses.dataclass(frozen=True)
class Arm:
    """The indices of one arm in the vectors of a task. The parts of all arms have the same lengths."""

    observation: Sequence[int]
    goal: Sequence[int]
    action: Sequence[int]
    position: Sequence[int] = ()
    """Indices, in the observation, of positions along the axis on which the arms face each other; may be empty."""
    lateral: Sequence[int] = ()
    """Indices of the coordinates of the same positions along the horizontal axis perpendicular to it; may be empty."""
    hand: Sequence[int] = ()
    """Indices of the three coordinates of the hand: along that axis, across it and up; may be empty."""


@dataclasses.dataclass(frozen=True)
class Condition:
    """A condition on an observation: some of its numbers lie within a distance of given values, in the task's norm."""

    numbers: Sequence[int]
    """Indices in the observation."""
    tolerance: float
    """The largest distance."""
    target: Sequence[float] = ()
    """One value for each index; empty means zeros."""

    def holds(self, norm: Norm, observation: Floats) -> bool:
        """Returns whether `observation`, shape `[n_observation]`, satisfies the condition."""
        numbers = observation[list(self.numbers)]
        target = self.target if len(self.target) else np.zeros_like(numbers)
        return distance(norm, numbers, np.asarray(target)) <= self.tolerance


@dataclasses.dataclass(frozen=True)
class ArmManipulation:
    """How an arm manipulates its object. All indices belong to the arm."""

    gripper: int | None = None
    """Index of the action that opens the gripper if it is positive. Exploration opens no gripper that holds an object."""
    holding: Sequence[Condition] = ()
    """Conditions under which the arm holds its object. If there are any, success needs them."""
    conditions: Sequence[Condition] = ()
    """Further conditions of success."""


@dataclasses.dataclass(frozen=True)
class Manipulation:
    """What the arms share, when they hold objects, and what success needs beyond the distance to the goal."""

    shared_object: bool = False
    """Whether all arms act on one object. Hindsight goals of all arms then come from one later step, and parts of arms
    from different steps are not recombined."""
    one_arm_task: str = ""
    """Name of the task that each arm by itself performs, which is the teacher's; empty if it is this task's."""
    success_steps: int = 1
    """Number of steps at the end of an episode after all of which the goal must be achieved."""
    arms: Sequence[ArmManipulation] = ()
    """The arms in order, or none."""

    def to_message(self) -> task_pb2.TaskManipulation:
        """Returns the message `tandem.v1.TaskManipulation`."""
        message = task_pb2.TaskManipulation(
            shared_object=self.shared_object, one_arm_task=self.one_arm_task, success_steps=self.success_steps
        )
        for arm in self.arms:
            holding, conditions = (
                [task_pb2.Condition(numbers=c.numbers, target=c.target, tolerance=c.tolerance) for c in given]
                for given in (arm.holding, arm.conditions)
            )
            message.arms.add(gripper=arm.gripper, holding=holding, conditions=conditions)
        return message

    @classmethod
    def from_message(cls, message: task_pb2.TaskManipulation) -> Manipulation:
        """Returns what `message` describes."""

        def conditions(given: Sequence[task_pb2.Condition]) -> tuple[Condition, ...]:
            return tuple(Condition(tuple(c.numbers), c.tolerance, tuple(c.target)) for c in given)

        arms = (
            ArmManipulation(
                arm.gripper if arm.HasField("gripper") else None, conditions(arm.holding), conditions(arm.conditions)
            )
            for arm in message.arms
        )
        return cls(message.shared_object, message.one_arm_task, max(message.success_steps, 1), tuple(arms))


@dataclasses.dataclass(frozen=True)
class Reflection:
    """A mirror symmetry: it turns an arm's part of a valid transition into that of another one.

    With several arms it holds while the arm is far enough from the others to be recombined, or always if it is that of
    the whole scene.

    Places are indices within the vector of one arm: 0 is the arm's first number.
    """

    observation: Sequence[int] = ()
    """Places in an observation whose numbers change their sign."""
    position: Sequence[int] = ()
    """Places in an observation of coordinates across the plane, which become twice that of the plane minus themselves."""
    goal: Sequence[int] = ()
    """Places in a goal of such coordinates."""
    action: Sequence[int] = ()
    """Places in an action whose numbers change their sign."""
    moved: Sequence[tuple[int, int]] = ()
    """Pairs of places in an observation: the first gets the number of the second."""
    plane: float = 0.0
    """The coordinate of the mirror plane."""
    whole_scene: bool = False
    """Whether the arms and their links mirror each other about one plane, so that all arms of a transition can be
    reflected at once, however near they are."""

    def to_message(self) -> task_pb2.Reflection:
        """Returns the message `tandem.v1.Reflection`."""
        message = task_pb2.Reflection(
            observation=self.observation,
            position=self.position,
            goal=self.goal,
            action=self.action,
            plane=self.plane,
            whole_scene=self.whole_scene,
        )
        for to, place in self.moved:
            # `from` is a keyword.
            message.moved.add(to=to, **{"from": place})
        return message

    @classmethod
    def from_message(cls, message: task_pb2.Reflection) -> Reflection:
        """Returns what `message` describes."""
        moved = tuple((pair.to, getattr(pair, "from")) for pair in message.moved)
        return cls(
            tuple(message.observation),
            tuple(message.position),
            tuple(message.goal),
            tuple(message.action),
            moved,
            message.plane,
            message.whole_scene,
        )


@dataclasses.dataclass(frozen=True)
class Task:
    """Everything that a learner, a teacher and workers know about a task."""

    name: str
    """1 to 64 lower-case letters, digits, '-', '_', '.' and '/'."""
    n_observation: int
    n_goal: int
    n_action: int
    arms: Sequence[Arm]
    achieved_goal: Sequence[int]
    """Indices of the achieved goal in the observation, shape `[n_goal]`."""
    episode_steps: int
    """Control steps per episode."""
    tolerance: float
    """The distance up to which a goal counts as achieved, in the unit of the goal."""
    norm: Norm = "euclidean"
    interchangeable_arms: bool = False
    """Whether exchanging the parts of two arms gives another valid transition."""
    reports_contacts: bool = False
    observation_bound: Sequence[float] = ()
    """The largest magnitude of each number, shape `[n_observation]`."""
    goal_bound: Sequence[float] = ()
    """The largest magnitude of each number, shape `[n_goal]`."""
    origin_distance: float = 0.0
    """The distance between the origins of two arms along the axis of their positions."""
    recombination_gap: float = 0.0
    """The smallest gap between arms whose parts are recombined: along that axis, or in the plane for arms with
    `lateral`."""
    base: float = 0.0
    """The coordinate of each arm's base along that axis, for arms with `lateral`."""
    contact_distances: Sequence[float] = ()
    """Distances along that axis, across it and up: hands that are nearer along all three are in contact. Empty if that
    is unknown; for arms with `hand`."""
    manipulation: Manipulation = Manipulation()
    """What the arms share, and what success needs beyond the distance to the goal."""
    reflection: Reflection = Reflection()
    """A mirror symmetry; none by default."""

    @classmethod
    def built_in(cls, name: str, n_arms: int = 1) -> Task:
        """Returns a task of Tandem's own simulator by its full name, such as `shared-push`. Units: metres, radians.

        Raises:
            ServiceError: If there is no such task.
        """
        try:
            return cls._from_json(_native.task_description(name, n_arms))
        except ValueError as error:
            raise ServiceError(f"{error}, or a Task") from error

    @classmethod
    def of_policy(cls, policy: Policy) -> Task:
        """Returns the task of a policy, which its file describes unless it is a built-in one."""
        if policy._description is None:
            return cls.built_in(policy.task, policy.n_arms)
        return cls._from_json(policy._description)

    @classmethod
    def _from_json(cls, description: str) -> Task:
        described = _frozen(json.loads(description))
        arms = tuple(Arm(**arm) for arm in described.pop("arms"))
        reflection = Reflection(**described.pop("reflection", {}))
        manipulation = described.pop("manipulation", {})
        acting = tuple(
            ArmManipulation(
                arm.get("gripper"),
                tuple(Condition(**condition) for condition in arm["holding"]),
                tuple(Condition(**condition) for condition in arm["conditions"]),
            )
            for arm in manipulation.pop("arms", ())
        )
        return cls(
            **described, arms=arms, reflection=reflection, manipulation=Manipulation(**manipulation, arms=acting)
        )

    def is_success(self, observation: Floats, goal: Floats) -> bool:
        """Returns whether each arm's part of the goal, the part common to all arms and all conditions are achieved.

        An episode is a success if this holds after each of its last `manipulation.success_steps` steps.

        Args:
            observation: Shape `[n_observation]`.
            goal: Shape `[n_goal]`.
        """
        achieved = observation[list(self.achieved_goal)]
        parts = [list(arm.goal) for arm in self.arms]
        parts.append(sorted(set(range(self.n_goal)).difference(*parts)))
        if any(distance(self.norm, achieved[part], goal[part]) > self.tolerance for part in parts if part):
            return False
        conditions = [c for arm in self.manipulation.arms for c in (*arm.holding, *arm.conditions)]
        return all(condition.holds(self.norm, observation) for condition in conditions)

    def check(self) -> None:
        """Checks every field as the services that receive the description do.

        Raises:
            ServiceError: A field has another type, or an invalid value.
        """
        try:
            # As a message the numbers are plain ones, with the bits that are sent.
            described = dataclasses.asdict(Task.from_message(self.to_message())) | {"norm": self.norm}
            _native.check_task(json.dumps(described, allow_nan=False))
        except (AttributeError, TypeError, ValueError) as error:
            raise ServiceError(f"the task cannot be described: {error}") from error

    def to_message(self) -> task_pb2.TaskDescription:
        """Returns the message `tandem.v1.TaskDescription`."""
        message = task_pb2.TaskDescription(
            name=self.name,
            n_observation=self.n_observation,
            n_goal=self.n_goal,
            n_action=self.n_action,
            achieved_goal=self.achieved_goal,
            episode_steps=self.episode_steps,
            tolerance=self.tolerance,
            norm=task_pb2.NORM_EUCLIDEAN if self.norm == "euclidean" else task_pb2.NORM_MAXIMUM,
            interchangeable_arms=self.interchangeable_arms,
            reports_contacts=self.reports_contacts,
            observation_bound=self.observation_bound,
            goal_bound=self.goal_bound,
            origin_distance=self.origin_distance,
            recombination_gap=self.recombination_gap,
            base=self.base,
            contact_distances=self.contact_distances,
        )
        for arm in self.arms:
            message.arms.add(
                observation=arm.observation,
                goal=arm.goal,
                action=arm.action,
                position=arm.position,
                lateral=arm.lateral,
                hand=arm.hand,
            )
        if self.manipulation != Manipulation():
            message.manipulation.CopyFrom(self.manipulation.to_message())
        if self.reflection != Reflection():
            message.reflection.CopyFrom(self.reflection.to_message())
        return message

    @classmethod
    def from_message(cls, message: task_pb2.TaskDescription) -> Task:
        """Returns the task that `message` describes."""
        arms = (
            Arm(
                tuple(a.observation),
                tuple(a.goal),
                tuple(a.action),
                tuple(a.position),
                tuple(a.lateral),
                tuple(a.hand),
            )
            for a in message.arms
        )
        return cls(
            name=message.name,
            n_observation=message.n_observation,
            n_goal=message.n_goal,
            n_action=message.n_action,
            arms=tuple(arms),
            achieved_goal=tuple(message.achieved_goal),
            episode_steps=message.episode_steps,
            tolerance=message.tolerance,
            norm="maximum" if message.norm == task_pb2.NORM_MAXIMUM else "euclidean",
            interchangeable_arms=message.interchangeable_arms,
            reports_contacts=message.reports_contacts,
            observation_bound=tuple(message.observation_bound),
            goal_bound=tuple(message.goal_bound),
            origin_distance=message.origin_distance,
            recombination_gap=message.recombination_gap,
            base=message.base,
            contact_distances=tuple(message.contact_distances),
            manipulation=Manipulation.from_message(message.manipulation),
            reflection=Reflection.from_message(message.reflection),
        )


def _frozen(value: Any) -> Any:
    """Returns `value` with tuples in place of lists."""
    if isinstance(value, dict):
        return {key: _frozen(item) for key, item in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def distance(norm: Norm, achieved: NDArray[Any], desired: NDArray[Any]) -> float:
    """Returns the distance between two goals, shape `[n_goal]` each."""
    difference = np.asarray(achieved, np.float64) - np.asarray(desired, np.float64)
    return float(np.linalg.norm(difference) if norm == "euclidean" else np.abs(difference).max())
