"""Two Fetch robots that face each other over one table, each with a cube of its own: Gymnasium-Robotics' Fetch, twice.

`import tandem` registers `tandem/TwoFetchPush-v0` and `tandem/TwoFetchPickAndPlace-v0`. Needs `pip install
'tandem-rl[fetch]'`: robots, meshes and cubes are read from the installed package.
"""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from tandem.envs import check_rendering, compute_reward

try:
    import gymnasium_robotics
    import mujoco
    from gymnasium_robotics.utils import mujoco_utils, rotations
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f"{error}: pip install 'tandem-rl[fetch]'", name=error.name) from None

Floats = NDArray[np.float64]
Observation = dict[str, Floats]

OBSERVATION, GOAL, ACTION = 25, 3, 4
"""Numbers of one arm, those of `FetchPush-v4`."""
TOLERANCE_M = 0.05
_ASSETS = Path(gymnasium_robotics.__file__).parent / "envs" / "assets" / "fetch"
_SUBSTEPS = 20
_CONTACT_CHECKS = 4
"""Looks for contacts between the arms within a control step, at equal distances."""
_START_X_M = 1.3419
"""The hand's x at the start of an episode, in its arm's frame; in task push it is 4 mm more."""
_TABLE_EDGE_X_M, _TABLE_Y_M = 1.05, 0.75
"""The edge of Fetch's table on the robot's side, and the centre of the table, in the arm's frame."""
_BASE = {"robot0:slide0": 0.405, "robot0:slide1": 0.48, "robot0:slide2": 0.0}
_OBJECT_START = (1.25, 0.53, 0.4, 1.0, 0.0, 0.0, 0.0)
_DOWNWARD = np.array([1.0, 0.0, 1.0, 0.0])
_TO_START_M = np.array([-0.498, 0.005, -0.431])
_RANGE_M = 0.15
"""Objects and goals lie within this distance of the hand's start, along each axis."""
_CLEARANCE_M = 0.1
"""Smallest distance between an object and the starts of the hands, and between two objects."""
_CLOSE_GOALS_M = (0.07, 0.15)
"""Smallest and largest horizontal distance of the goals of two arms; cubes have edges of 5 cm."""
RECOMBINATION_GAP_M = 0.15
"""A distance along x between the hands and cubes of two arms at which nothing touches; wrists touch at 0.12 m."""


@dataclasses.dataclass(frozen=True)
class _Task:
    """What differs between the tasks, with the values of `FetchPush-v4` and `FetchPickAndPlace-v4`."""

    model: str
    one_arm_name: str
    blocks_fingers: bool
    extra_height_m: float
    lifts_goals: bool


_TASKS = {
    "push": _Task("push.xml", "fetchpush-v4", True, 0.0, False),
    "pick-and-place": _Task("pick_and_place.xml", "fetchpickandplace-v4", False, 0.2, True),
}


class TwoFetchEnv(gymnasium.Env[Observation, Floats]):
    """Two Fetch robots, each with a cube and a goal, in one MuJoCo model.

    Solver, masses, friction, mocap welds, 20 substeps of 2 ms and the order of every operation are those of
    Gymnasium-Robotics' Fetch environments. The second robot is turned by half a turn; both share a table that is as
    long as needed. Each arm's 25 numbers, goal and action have the meaning they have in `FetchPush-v4` and are in the
    arm's own frame, in which the arm stands where Fetch stands. Vectors of the arms are concatenated.

    Objects and goals are drawn within 15 cm of the start of their hand along each axis, as in Fetch's environments.
    Objects are at least 10 cm from the starts of both hands and from each other. The goals of the arms are 7 to 15 cm
    apart, so that both arms have to work in the same place.

    The reward is 0 if the distance between both achieved and desired positions, taken together, is at most 5 cm, and
    -1 otherwise. `info["is_success"]` holds if each cube is within 5 cm of its goal; `info["arm_contact"]` reports
    contacts between the two robots during the step.

    Args:
        task: `"push"` or `"pick-and-place"`.
        distance: Distance between the starts of the two hands along x, metres; in task push they are 7 mm closer.
        close_goals: Whether the goals are at most 15 cm apart; with False they are at least 10 cm apart.
        render_mode: `"rgb_array"` or None.
        width: Width of pictures, pixels.
        height: Height of pictures, pixels.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(
        self,
        task: str = "push",
        *,
        distance: float = 0.2,
        close_goals: bool = True,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 400,
    ) -> None:
        check_rendering(render_mode, width, height)
        if task not in _TASKS:
            raise ValueError(f"unknown task {task!r}: expected one of {', '.join(_TASKS)}")
        longest = 0.35 if close_goals else 10.0
        if not 0.15 <= distance <= longest:
            raise ValueError(f"distance is {distance} m, expected 0.15 to {longest}")
        self._task = _TASKS[task]
        self._goal_gaps_m = _CLOSE_GOALS_M if close_goals else (_CLEARANCE_M, np.inf)
        self._origin_distance = 2 * _START_X_M + distance
        self.render_mode = render_mode
        self._size = (width, height)
        self._renderer: Any = None
        self._is_started = False
        self._model = _model(self._task, self._origin_distance)
        self._data = mujoco.MjData(self._model)
        turned = np.array([self._origin_distance, 2 * _TABLE_Y_M, 0.0])
        self._arms = [_Arm(self._model, "", None), _Arm(self._model, "second:", turned)]
        self._robot_of_geom = np.full(self._model.ngeom, -1)
        for idx, arm in enumerate(self._arms):
            self._robot_of_geom[arm.geoms] = idx
        self._place_robots()
        unbounded = {"observation": OBSERVATION, "achieved_goal": GOAL, "desired_goal": GOAL}
        boxes: dict[str, spaces.Space[Any]] = {
            name: spaces.Box(-np.inf, np.inf, (2 * n,), np.float64) for name, n in unbounded.items()
        }
        self.observation_space = cast(spaces.Space[Observation], spaces.Dict(boxes))
        self.action_space = cast(spaces.Space[Floats], spaces.Box(-1.0, 1.0, (2 * ACTION,), np.float32))

    @property
    def tandem_task(self) -> dict[str, Any]:
        """Options of `tandem.serve` that describe the arms; the name is that of the task for one arm."""
        from tandem._fetch import FETCH_REFLECTION
        from tandem._task import Arm

        arms = []
        for idx in range(2):
            first = OBSERVATION * idx
            observation = range(first, first + OBSERVATION)
            goal, action = range(GOAL * idx, GOAL * (idx + 1)), range(ACTION * idx, ACTION * (idx + 1))
            arms.append(Arm(observation, goal, action, position=(first, first + 3)))
        return {
            "name": self._task.one_arm_name,
            "arms": arms,
            "achieved_goal": (3, 4, 5, OBSERVATION + 3, OBSERVATION + 4, OBSERVATION + 5),
            "interchangeable_arms": True,
            "origin_distance": self._origin_distance,
            "recombination_gap": RECOMBINATION_GAP_M,
            "reflection": FETCH_REFLECTION,
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode; `options` must be empty.

        Raises:
            ValueError: There are options; nothing has changed.
        """
        if options:
            raise ValueError(f"unknown options {sorted(options)}: expected none")
        super().reset(seed=seed)
        objects, goals = self._draw_objects(), self._draw_goals()
        return self.start(objects, goals), self._info(False)

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Executes `action`, shape `[8]`, for one control step of 0.04 s.

        Raises:
            ValueError: The action has another length or contains a number that is not finite; nothing has moved.
        """
        if not self._is_started:
            raise RuntimeError("the environment has no episode yet: call reset first")
        numbers = np.asarray(action, np.float64)
        if numbers.shape != (2 * ACTION,) or not np.isfinite(numbers).all():
            raise ValueError(f"expected an action of {2 * ACTION} finite numbers, got {numbers}")
        for arm, own in zip(self._arms, np.clip(numbers, -1, 1).reshape(2, ACTION)):
            arm.command(self._model, self._data, own, self._task.blocks_fingers)
        touched = False
        for _ in range(_CONTACT_CHECKS):
            mujoco.mj_step(self._model, self._data, nstep=_SUBSTEPS // _CONTACT_CHECKS)
            touched = touched or self._arms_touch()
        if self._task.blocks_fingers:
            for arm in self._arms:
                self._data.qpos[arm.fingers_qpos] = 0.0
            mujoco.mj_forward(self._model, self._data)
        observation = self._observe()
        reward = float(compute_reward(observation["achieved_goal"], self._goals))
        return observation, reward, False, False, self._info(touched)

    def start(self, objects: ArrayLike, goals: ArrayLike) -> Observation:
        """Starts an episode with the given positions, and returns the observation.

        Args:
            objects: x and y of each cube in its arm's frame, shape `[2, 2]`, metres.
            goals: The goal of each arm in its frame, shape `[2, 3]`, metres.
        """
        model, data = self._model, self._data
        self._goals = np.array(goals, np.float64).reshape(2 * GOAL)
        mujoco.mj_resetData(model, data)
        data.time, data.qpos[:], data.qvel[:] = self._first_time, self._first_qpos, self._first_qvel
        for arm, xy, goal in zip(self._arms, np.array(objects, np.float64).reshape(2, 2), self._goals.reshape(2, 3)):
            data.qpos[arm.object_qpos : arm.object_qpos + 2] = arm.to_world(np.append(xy, 0.0))[:2]
            model.site_pos[arm.target] = goal - arm.from_world(model.body_pos[model.site_bodyid[arm.target]])
        mujoco.mj_forward(model, data)
        self._is_started = True
        return self._observe()

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """Returns the sparse rewards of goals of shape `[..., 6]`, shape `[...]`; `info` has no effect."""
        return compute_reward(achieved_goal, desired_goal)

    def render(self) -> NDArray[np.uint8] | None:
        """Draws the scene, shape `[height, width, 3]`, in render mode `rgb_array`."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            width, height = self._size
            self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
            self._renderer = mujoco.Renderer(self._model, height, width)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = (self._origin_distance / 2, _TABLE_Y_M, 0.5)
        camera.distance, camera.azimuth, camera.elevation = 2.2, 90.0, -25.0
        self._renderer.update_scene(self._data, camera)
        picture: NDArray[np.uint8] = self._renderer.render()
        return picture

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        # MuJoCo's data are pickled with every number of the episode; a renderer belongs to its process.
        return {**self.__dict__, "_renderer": None}

    def __copy__(self) -> TwoFetchEnv:
        # A shallow copy would share MuJoCo's data.
        return copy.deepcopy(self)

    def _place_robots(self) -> None:
        """Takes over the state in which Fetch's environments start, for each arm in its frame.

        On their way from their initial pose the robots would meet, so each one moves alone.
        """
        model, data = self._model, self._data
        alone = mujoco.MjModel.from_xml_path(str(_ASSETS / self._task.model))
        settled = _settled(alone, self._task.extra_height_m)
        for arm in self._arms:
            for idx in range(alone.njnt):
                joint = alone.joint(idx)
                own = model.joint(arm.prefix + joint.name)
                qpos, qvel = settled.joint(idx).qpos, settled.joint(idx).qvel
                if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                    # Free joints rotate in the frame of their body and move in that of the world.
                    qpos, qvel = arm.pose_to_world(qpos), np.append(arm.direction_to_world(qvel[:3]), qvel[3:])
                data.qpos[own.qposadr[0] : own.qposadr[0] + len(qpos)] = qpos
                data.qvel[own.dofadr[0] : own.dofadr[0] + len(qvel)] = qvel
        self._first_time, self._first_qpos, self._first_qvel = settled.time, data.qpos.copy(), data.qvel.copy()
        self._hand_start = settled.site("robot0:grip").xpos.copy()
        self._object_height = float(settled.site("object0").xpos[2])
        self._goals = np.zeros(2 * GOAL)
        mujoco_utils.reset_mocap_welds(model, data)

    def _draw_objects(self) -> Floats:
        """Draws x and y of the cubes in their arms' frames, shape `[2, 2]`."""
        hands = [arm.to_world(self._hand_start)[:2] for arm in self._arms]
        while True:
            own = self._hand_start[:2] + self.np_random.uniform(-_RANGE_M, _RANGE_M, (2, 2))
            placed = [arm.to_world(np.append(xy, 0.0))[:2] for arm, xy in zip(self._arms, own)]
            others = [(xy, hand) for xy in placed for hand in hands] + [(placed[0], placed[1])]
            if all(np.linalg.norm(a - b) >= _CLEARANCE_M for a, b in others):
                return cast(Floats, own)

    def _draw_goals(self) -> Floats:
        """Draws the goals of the arms in their frames, shape `[2, 3]`."""
        least, most = self._goal_gaps_m
        while True:
            goals = self._hand_start + self.np_random.uniform(-_RANGE_M, _RANGE_M, (2, 3))
            goals[:, 2] = self._object_height
            for goal in goals if self._task.lifts_goals else ():
                if self.np_random.uniform() < 0.5:
                    goal[2] += self.np_random.uniform(0, 0.45)
            placed = [arm.to_world(goal) for arm, goal in zip(self._arms, goals)]
            if least <= np.linalg.norm((placed[0] - placed[1])[:2]) <= most:
                return cast(Floats, goals)

    def _observe(self) -> Observation:
        own = [arm.observe(self._model, self._data) for arm in self._arms]
        return {
            "observation": np.concatenate(own),
            "achieved_goal": np.concatenate([observation[3:6] for observation in own]),
            "desired_goal": self._goals.copy(),
        }

    def _info(self, touched: bool) -> dict[str, Any]:
        achieved = np.array([self._data.site_xpos[arm.object_site] for arm in self._arms])
        achieved = np.array([arm.from_world(position) for arm, position in zip(self._arms, achieved)])
        apart = np.linalg.norm(achieved - self._goals.reshape(2, GOAL), axis=1)
        return {"is_success": bool((apart <= TOLERANCE_M).all()), "arm_contact": touched}

    def _arms_touch(self) -> bool:
        contact = self._data.contact
        robots = self._robot_of_geom[contact.geom]
        return bool(((robots[:, 0] + robots[:, 1] == 1) & (robots.min(axis=1) == 0) & (contact.dist <= 0)).any())


class _Arm:
    """The parts of one robot in the model, and its frame.

    `turn` is None for the robot that stands as Fetch does. Otherwise the frame is turned about the z axis by half a
    turn, and `turn` is its origin in the world.
    """

    def __init__(self, model: Any, prefix: str, turn: Floats | None) -> None:
        self.prefix, self.turn = prefix, turn
        hand = model.body(prefix + "robot0:gripper_link").id
        self.hand = hand
        self.mocap = int(model.body(prefix + "robot0:mocap").mocapid[0])
        self.grip = model.site(prefix + "robot0:grip").id
        self.object_site = model.site(prefix + "object0").id
        self.target = model.site(prefix + "target0").id
        self.object_qpos = int(model.joint(prefix + "object0:joint").qposadr[0])
        fingers = [model.joint(f"{prefix}robot0:{side}_gripper_finger_joint") for side in "rl"]
        self.fingers_qpos = [int(finger.qposadr[0]) for finger in fingers]
        self.fingers_qvel = [int(finger.dofadr[0]) for finger in fingers]
        self.actuators = [
            idx for idx in range(model.nu) if model.actuator(idx).name.startswith(prefix + "robot0:")
        ]
        self.actuated_qpos = [int(model.jnt_qposadr[model.actuator_trnid[idx, 0]]) for idx in self.actuators]
        base = model.body(prefix + "robot0:base_link").id
        self.geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == base)

    def to_world(self, own: Floats) -> Floats:
        """Returns the position in the world of a position in the arm's frame."""
        return own if self.turn is None else self.turn + own * _HALF_TURN

    def from_world(self, position: Floats) -> Floats:
        """Returns a copy of a position in the world, in the arm's frame."""
        return position.copy() if self.turn is None else (position - self.turn) * _HALF_TURN

    def direction_to_world(self, own: Floats) -> Floats:
        """Returns the direction in the world of a direction in the arm's frame."""
        return own if self.turn is None else own * _HALF_TURN

    def turned(self, quaternion: Floats) -> Floats:
        """Returns the quaternion in the world of one in the arm's frame."""
        if self.turn is None:
            return quaternion
        w, x, y, z = quaternion
        return np.array([-z, -y, x, w])

    def pose_to_world(self, own: Floats) -> Floats:
        """Returns position and quaternion in the world, shape `[7]`."""
        return np.concatenate([self.to_world(own[:3]), self.turned(own[3:])])

    def command(self, model: Any, data: Any, action: Floats, blocks_fingers: bool) -> None:
        """Moves the mocap body from the hand by the action, shape `[4]`, as Fetch's environments do."""
        data.mocap_pos[self.mocap] = data.xpos[self.hand] + self.direction_to_world(action[:3] * 0.05)
        data.mocap_quat[self.mocap] = data.xquat[self.hand] + self.turned(_DOWNWARD)
        fingers = 0.0 if blocks_fingers else action[3]
        for actuator, qpos in zip(self.actuators, self.actuated_qpos):
            data.ctrl[actuator] = data.qpos[qpos] + fingers

    def observe(self, model: Any, data: Any) -> Floats:
        """Returns the arm's numbers, shape `[25]`."""
        dt = _SUBSTEPS * model.opt.timestep
        hand, hand_velocity, _ = self._site(model, data, self.grip, dt)
        cube, velocity, turning = self._site(model, data, self.object_site, dt)
        rotation = data.site_xmat[self.object_site].reshape(3, 3)
        if self.turn is not None:
            rotation = _HALF_TURN[:, None] * rotation
        parts = [hand, cube, cube - hand, data.qpos[self.fingers_qpos], rotations.mat2euler(rotation)]
        parts += [velocity - hand_velocity, turning, hand_velocity, data.qvel[self.fingers_qvel] * dt]
        return np.concatenate(parts)

    def _site(self, model: Any, data: Any, site: int, dt: float) -> tuple[Floats, Floats, Floats]:
        """Returns a site's position, and its linear and angular movement per control step, shape `[3]` each."""
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, linear, angular, site)
        movements = [jacobian @ data.qvel * dt for jacobian in (linear, angular)]
        linear, angular = (self.direction_to_world(movement) for movement in movements)
        return self.from_world(data.site_xpos[site]), linear, angular


def _settled(model: Any, extra_height_m: float) -> Any:
    """Moves the hand of Fetch's own model to its start, as Fetch's environments do, and returns the data."""
    data = mujoco.MjData(model)
    for name, value in _BASE.items():
        mujoco_utils.set_joint_qpos(model, data, name, value)
    mujoco_utils.set_joint_qpos(model, data, "object0:joint", _OBJECT_START)
    mujoco_utils.reset_mocap_welds(model, data)
    target = _TO_START_M + (0.0, 0.0, extra_height_m) + data.site("robot0:grip").xpos
    mujoco_utils.set_mocap_pos(model, data, "robot0:mocap", target)
    mujoco_utils.set_mocap_quat(model, data, "robot0:mocap", _DOWNWARD)
    for _ in range(10):
        mujoco.mj_step(model, data, nstep=_SUBSTEPS)
    return data


_HALF_TURN = np.array([-1.0, -1.0, 1.0])
"""The diagonal of the rotation by half a turn about z."""


def _model(task: _Task, origin_distance: float) -> Any:
    """Compiles Fetch's model with a second robot, turned by half a turn, and its cube."""
    path = str(_ASSETS / task.model)
    spec, second = mujoco.MjSpec.from_file(path), mujoco.MjSpec.from_file(path)
    table = spec.body("table0")
    table.pos = [origin_distance / 2, _TABLE_Y_M, 0.2]
    table.first_geom().size[0] = origin_distance / 2 - _TABLE_EDGE_X_M
    second.delete(second.body("table0"))
    for shared in [second.geom("floor0"), *second.worldbody.lights]:
        second.delete(shared)
    frame = spec.worldbody.add_frame(pos=[origin_distance, 2 * _TABLE_Y_M, 0.0], quat=[0.0, 0.0, 0.0, 1.0])
    spec.attach(second, prefix="second:", frame=frame)
    return spec.compile()
