"""The simulated world of `tandem scene` in MuJoCo: bodies, the control law of the hands, and observations.

All numbers come from the output of `tandem scene --json`; docs/transfer.md lists what differs between the engines.
Vectors are in the world frame unless a name says otherwise; an arm's frame is the world frame shifted to the arm's
origin and, for the second of two arms, rotated by 180 degrees about z. A palm's frame has its origin at the end
effector; fingers close along y, and the hand points along -z. It is parallel to the arm's frame if the hand is upright.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from mujoco_kinematics import Jaco, Mico, VelocityDamper, bounded, cross

ARM_ARM, ARM_TABLE = "arm-arm", "arm-table"
# Number of fingers in an observation.
N_OBSERVED_FINGERS = 3


@dataclass(frozen=True)
class ContactModel:
    """Parameters of MuJoCo's contacts, which rapier's do not have."""

    # Time constant of a contact, seconds. MuJoCo bounds it from below by two of its steps; four do not overshoot.
    time_constant_s: float = 0.004
    # "elliptic", as Coulomb's cone is, or "pyramidal", MuJoCo's default.
    cone: str = "elliptic"
    # Ratio of frictional to normal impedance; more means less slip. MuJoCo's default is 1.
    impratio: float = 10.0
    # Divides MuJoCo's step further.
    refinement: int = 1
    # Moment of inertia of the bodies of a hand that tilts, kg m^2. It stands for an infinite one: a torque of 7 N m,
    # 40 N at the upper end of the hand, changes the angular velocity by 2e-3 rad/s until the arm sets it again. With
    # larger ones MuJoCo's solver ends before contacts have converged.
    hand_inertia_kgm2: float = 10.0


def limit_speed(velocity, most_mps):
    """`velocity`, shortened to the length `most_mps` if there is such a limit."""
    if most_mps is None:
        return velocity
    speed_mps = math.sqrt(velocity @ velocity)
    return velocity * (most_mps / speed_mps) if speed_mps > most_mps else velocity


def numbers(values):
    return " ".join(f"{value:.9g}" for value in np.atleast_1d(values))


def has_tilting_hands(world):
    return world["kinematics"]["arm"] == "mico"


def mass_kg(world, body):
    shapes = [shape["mass_kg"] for shape in world["shapes"] if shape["body"] == body]
    return world["bodies"][body]["own_mass_kg"] + sum(shapes)


def mjcf(world, contact):
    """Returns the MuJoCo model of `world` as MJCF.

    The bodies of an upright hand, which cannot rotate, have three slide joints along the world's axes; their shapes
    carry the rotation of the arm. Those of a hand that tilts are free and have so large a moment of inertia that
    contacts do not turn them. Only the pairs of shapes that `world` lists collide, each with its own friction. Rapier
    integrates positions `solver_iterations` times per physics step under constant forces, and so does MuJoCo here.
    """
    signs = [arm["sign"] for arm in world["arms"]]
    tilting = has_tilting_hands(world)

    def slides(description):
        return not description["rotates"] and not tilting

    def geom(idx, shape):
        turn = signs[shape["arm"]] if shape["body"] is not None and slides(world["bodies"][shape["body"]]) else 1
        x, y, z = shape["position_m"]
        if "box_half_extents_m" in shape:
            form = f'type="box" size="{numbers(shape["box_half_extents_m"])}"'
        else:
            form = f'type="capsule" size="{numbers(shape["capsule_radius_and_half_length_m"])}"'
        mass = f'mass="{numbers(shape["mass_kg"])}"' if shape["body"] is not None else ""
        position = numbers([turn * x, turn * y, z])
        return f'<geom name="{idx}" {form} pos="{position}" {mass} contype="0" conaffinity="0"/>'

    def body(idx, description):
        shapes = "".join(geom(at, shape) for at, shape in enumerate(world["shapes"]) if shape["body"] == idx)
        if slides(description):
            joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
        else:
            joints = "<freejoint/>"
        if tilting and not description["rotates"]:
            inertia = numbers([contact.hand_inertia_kgm2] * 3)
            joints += f'<inertial pos="0 0 0" mass="{numbers(mass_kg(world, idx))}" diaginertia="{inertia}"/>'
        weightless = 1.0 - description["gravity_scale"]
        return f'<body name="body{idx}" gravcomp="{weightless}">{joints}{shapes}</body>'

    def pair(description):
        first, second = description["shapes"]
        friction = numbers([description["friction"]] * 2 + [0.0] * 3)
        return (
            f'<pair geom1="{first}" geom2="{second}" condim="3" friction="{friction}" '
            f'solref="{contact.time_constant_s} 1"/>'
        )

    fixed = "".join(geom(at, shape) for at, shape in enumerate(world["shapes"]) if shape["body"] is None)
    bodies = "".join(body(idx, description) for idx, description in enumerate(world["bodies"]))
    pairs = "".join(pair(description) for description in world["contact_pairs"])
    timestep = world["control_step_s"] / world["substeps"] / world["solver_iterations"] / contact.refinement
    return (
        f'<mujoco><option timestep="{timestep}" gravity="{numbers(world["gravity_mps2"])}" cone="{contact.cone}" '
        f'impratio="{contact.impratio}"/><worldbody>{fixed}{bodies}</worldbody><contact>{pairs}</contact></mujoco>'
    )


class Arm:
    """One arm: its frame, the addresses of its bodies, its kinematics and the motion of its hand."""

    def __init__(self, world, description, model):
        self.sign = np.array([description["sign"], description["sign"], 1.0])
        self.origin = np.array(description["origin_m"])
        self.fingers = description["fingers"]
        self.palm, self.object = (dof(model, description[part]) for part in ("palm", "object"))
        self.finger_dofs = np.array([dof(model, finger["body"]) for finger in self.fingers], dtype=int)
        self.finger_axes = self.finger_dofs[:, None] + np.arange(3)
        self.object_qpos = model.jnt_qposadr[model.body_jntadr[model.body(f"body{description['object']}").id]]
        # The point of the object that the arm brings to its goal, in the object's frame: its centre, or a handle.
        self.object_point = np.array(description["object_point_m"])
        # An object of both arms looks the same to both.
        self.is_shared = len({arm["object"] for arm in world["arms"]}) < len(world["arms"])
        # Places of the closed fingers and directions of opening in the palm's frame.
        self.closed_offsets = np.array([self.sign * finger["closed_offset_m"] for finger in self.fingers])
        self.outward = self.sign[1] * np.array([finger["outward"] for finger in self.fingers])
        self.masses_kg = np.array([finger["mass_kg"] for finger in self.fingers])
        self.mass_fractions = np.array([finger["mass_fraction"] for finger in self.fingers])
        # A gripper with fewer fingers than an observation shows its first one several times.
        n_fingers = len(self.fingers)
        self.observed = [0] * (N_OBSERVED_FINGERS - n_fingers) + list(range(n_fingers))
        self.tilts = has_tilting_hands(world)
        kind = Mico if self.tilts else Jaco
        self.kinematics = kind(world["kinematics"], world["link_avoidance"])
        self.turn(self.origin, np.zeros(3))

    def turn(self, palm, velocity):
        """Finds orientation [3, 3] and angular velocity of the hand from the palm's position and velocity."""
        orientation, spin = self.kinematics.motion(self.arm_from_world(palm), self.sign * velocity)
        self.orientation, self.angular_velocity = self.sign[:, None] * orientation, self.sign * spin

    def orient(self, palm):
        """Finds the orientation alone."""
        orientation, _ = self.kinematics.motion(self.arm_from_world(palm), np.zeros(3))
        self.orientation = self.sign[:, None] * orientation

    def arm_from_world(self, point):
        return self.sign * (point - self.origin)

    def world_from_arm(self, point):
        return self.sign * point + self.origin

    def orientation_in_arm(self, wxyz):
        """A body's orientation in the arm's frame as (x, y, z, w) with w >= 0."""
        w, x, y, z = wxyz
        if self.sign[0] > 0:
            in_arm = np.array([x, y, z, w])
        else:
            in_arm = np.array([-x, -y, z, w] if self.is_shared else [-y, x, w, -z])
        return -in_arm if in_arm[3] < 0.0 else in_arm

    def orientation_in_world(self, xyzw):
        """A body's orientation as (w, x, y, z), from that in the arm's frame."""
        x, y, z, w = xyzw
        if self.sign[0] > 0:
            return [w, x, y, z]
        return [w, -x, -y, z] if self.is_shared else [-z, -y, x, w]

    def lever(self, wxyz):
        """The arm's point of its object relative to the object's centre, from the object's orientation."""
        lever = np.zeros(3)
        mujoco.mju_rotVecQuat(lever, self.object_point, wxyz)
        return lever


def in_reach(reach, at):
    """Moves a point (arm's frame) along its radius from the base's axis to the nearest one within reach."""
    axis_x_m, rings = reach["axis_x_m"], reach["rings"]
    radius_m = max(math.hypot(at[0] - axis_x_m, at[1]), np.finfo(np.float32).tiny)
    heights_m = [ring["height_m"] for ring in rings]
    low_m, high_m = (np.interp(at[2], heights_m, [ring["radii_m"][end] for ring in rings]) for end in (0, 1))
    scale = min(max(radius_m, low_m), high_m) / radius_m
    return np.array([axis_x_m + (at[0] - axis_x_m) * scale, at[1] * scale, at[2]])


def dof(model, body):
    """The address of a body's first degree of freedom."""
    return model.body_dofadr[model.body(f"body{body}").id]


class MujocoWorld:
    """The environment: reset to the start of a printed episode, observe, step."""

    def __init__(self, world, contact=ContactModel()):
        self.world, self.control, self.contact = world, world["hand"], contact
        self.step_s = world["control_step_s"] / world["substeps"]
        self.model = mujoco.MjModel.from_xml_string(mjcf(world, contact))
        self.data = mujoco.MjData(self.model)
        self.arms = [Arm(world, description, self.model) for description in world["arms"]]
        # A free joint has one position more than it has velocities, so the indices of the two differ.
        self.qpos_of_dof = self.model.jnt_qposadr[self.model.dof_jntid] + (
            np.arange(self.model.nv) - self.model.jnt_dofadr[self.model.dof_jntid]
        )
        self.contact_kinds = np.zeros((self.model.ngeom, self.model.ngeom), dtype=int)
        for first, second in (pair["shapes"] for pair in world["contact_pairs"]):
            parts = {world["shapes"][first]["part"], world["shapes"][second]["part"]}
            kind = 1 if parts == {"hand"} else 2 if parts == {"hand", "table"} else 0
            first, second = (self.model.geom(str(shape)).id for shape in (first, second))
            self.contact_kinds[first, second] = self.contact_kinds[second, first] = kind

    def position(self, dof):
        start = self.qpos_of_dof[dof]
        return self.data.qpos[start : start + 3]

    def velocity(self, dof):
        return self.data.qvel[dof : dof + 3]

    def reset(self, observation):
        """Places all bodies, at rest, as the first observation of an episode says."""
        mujoco.mj_resetData(self.model, self.data)
        for arm, numbers_of_arm in zip(self.arms, np.split(np.asarray(observation), len(self.arms))):
            palm = arm.world_from_arm(numbers_of_arm[0:3])
            self.position(arm.palm)[:] = palm
            arm.turn(palm, np.zeros(3))
            for idx, start in enumerate(arm.finger_dofs):
                opening = numbers_of_arm[9 + arm.observed.index(idx)]
                closed = palm + arm.orientation @ arm.closed_offsets[idx]
                self.position(start)[:] = closed + arm.orientation[:, 1] * (arm.outward[idx] * opening)
            if arm.tilts:
                self.turn_bodies(arm)
            at = arm.object_qpos
            quaternion = np.array(arm.orientation_in_world(numbers_of_arm[12:16]))
            self.data.qpos[at : at + 3] = arm.world_from_arm(numbers_of_arm[3:6]) - arm.lever(quaternion)
            self.data.qpos[at + 3 : at + 7] = quaternion
            arm.kinematics.start(arm.arm_from_world(palm))
        self.damper = None
        if len(self.arms) == 2:
            self.damper = VelocityDamper(self.world["link_avoidance"], self.arms[0].kinematics.radii_m)
            self.damper.update_posture([self.capsules(arm) for arm in self.arms])
        mujoco.mj_forward(self.model, self.data)

    def observe(self):
        """The observation, shape [28 * n_arms], in the order of Env::observe."""
        per_step = self.world["control_step_s"]
        rows = []
        for arm in self.arms:
            palm, palm_velocity = self.position(arm.palm), self.velocity(arm.palm)
            at, start = arm.object_qpos, arm.object
            quaternion, spin = self.data.qpos[at + 3 : at + 7], np.zeros(3)
            mujoco.mju_rotVecQuat(spin, self.data.qvel[start + 3 : start + 6], quaternion)
            lever = arm.lever(quaternion)
            thing, thing_velocity = self.data.qpos[at : at + 3] + lever, self.velocity(start) + cross(spin, lever)
            openings, rates = self.openings(arm)
            rows += [
                arm.arm_from_world(palm),
                arm.arm_from_world(thing),
                arm.sign * (thing - palm),
                openings,
                arm.orientation_in_arm(quaternion),
                arm.sign * (thing_velocity - palm_velocity) * per_step,
                arm.sign * spin * per_step,
                arm.sign * palm_velocity * per_step,
                rates * per_step,
            ]
        return np.concatenate(rows)

    def step(self, action):
        """Executes `action`, clipped to [-1, 1], for a control step and returns the contacts during it."""
        parts = np.split(np.clip(action, -1.0, 1.0), len(self.arms))
        targets = [self.target(arm, part[:3]) for arm, part in zip(self.arms, parts)]
        grippers = [part[3] if len(part) > 3 else -1.0 for part in parts]
        for arm in self.arms:
            arm.kinematics.track(arm.arm_from_world(self.position(arm.palm)))
        if self.damper:
            self.damper.update_posture([self.capsules(arm) for arm in self.arms])
        kinds = set()
        for _ in range(self.world["substeps"]):
            self.drive(targets, grippers)
            for _ in range(self.world["solver_iterations"] * self.contact.refinement):
                mujoco.mj_step(self.model, self.data)
                kinds |= self.hand_contacts()
        if self.damper and self.damper.min_gap_m < 0.0:
            kinds.add(1)
        return {ARM_ARM if kind == 1 else ARM_TABLE for kind in kinds}

    def target(self, arm, displacement):
        """Where `displacement` (arm's frame, in [-1, 1]) moves the palm: to the nearest point of its workspace."""
        at = arm.arm_from_world(self.position(arm.palm)) + displacement * self.control["action_m"]
        at = np.clip(at, self.control["workspace_low_m"], self.control["workspace_high_m"])
        if self.control["reach"]:
            at = in_reach(self.control["reach"], at)
        return arm.world_from_arm(at)

    def drive(self, targets, grippers):
        """Sets the forces on the hands for the next physics step."""
        palms = [self.position(arm.palm) for arm in self.arms]
        gain, most_mps = self.control["approach_gain_per_s"], self.control["max_speed_mps"]
        velocities = [limit_speed((target - palm) * gain, most_mps) for target, palm in zip(targets, palms)]
        if self.damper:
            velocities = self.damper.limit(palms, velocities)
            velocities = [limit_speed(velocity, most_mps) for velocity in velocities]
        for arm, velocity, gripper in zip(self.arms, velocities, grippers):
            self.drive_hand(arm, velocity, gripper)

    def drive_hand(self, arm, velocity, gripper):
        control, forces = self.control, self.data.qfrc_applied
        palm_velocity = self.velocity(arm.palm)
        if arm.tilts:
            arm.turn(self.position(arm.palm), palm_velocity)
            self.turn_bodies(arm)
        limit = control["palm_force_n"]
        palm_force = bounded((velocity - palm_velocity) * (control["mass_kg"] / self.step_s), limit)
        forces[arm.palm : arm.palm + 3] = palm_force
        if not arm.fingers:
            return
        next_velocity = palm_velocity + palm_force * (self.step_s / control["mass_kg"])
        finger_forces = self.finger_forces(arm, next_velocity, gripper)
        forces[arm.finger_axes] = finger_forces
        forces[arm.palm : arm.palm + 3] -= finger_forces.sum(axis=0)

    def finger_forces(self, arm, palm_velocity, gripper):
        """The forces that open or close the fingers together and hold each in its place, [n, 3]."""
        control, step_s = self.control, self.step_s
        offsets, velocities = self.finger_states(arm, palm_velocity)
        openings, rates = offsets[:, 1] * arm.outward, velocities[:, 1] * arm.outward
        opening, rate = arm.mass_fractions @ openings, arm.mass_fractions @ rates
        end_gain = control["opening_end_gain"] / step_s
        desired = min(
            max(gripper * control["opening_speed_mps"], -opening * end_gain),
            (control["max_opening_m"] - opening) * end_gain,
        )
        grip = control["grip_force_n"]
        side = bounded(0.5 * control["fingers_mass_kg"] * (desired - rate) / step_s, grip)
        gains, hold = arm.masses_kg / step_s, control["finger_hold_gain_per_s"]
        limit = control["finger_hold_force_n"]
        held = bounded((-hold * offsets - velocities) * gains[:, None], limit)
        balancing = bounded(gains * (hold * (opening - openings) + rate - rates), limit)
        held[:, 1] = arm.outward * (2.0 * arm.mass_fractions * side + balancing)
        return held @ arm.orientation.T

    def turn_bodies(self, arm):
        """Gives the bodies of a hand that tilts its orientation, and its angular velocity in their own frames."""
        quaternion, spin = np.zeros(4), arm.angular_velocity @ arm.orientation
        mujoco.mju_mat2Quat(quaternion, arm.orientation.ravel())
        for start in (arm.palm, *arm.finger_dofs):
            at = self.qpos_of_dof[start]
            self.data.qpos[at + 3 : at + 7] = quaternion
            self.data.qvel[start + 3 : start + 6] = spin

    def finger_states(self, arm, palm_velocity):
        """Positions of the fingers relative to the closed ones, and velocities relative to the palm, [n, 3] each, in
        the palm's frame.
        """
        levers = self.data.qpos[self.qpos_of_dof[arm.finger_axes]] - self.position(arm.palm)
        carried = palm_velocity + cross(arm.angular_velocity, levers) if arm.tilts else palm_velocity
        velocities = self.data.qvel[arm.finger_axes] - carried
        return levers @ arm.orientation - arm.closed_offsets, velocities @ arm.orientation

    def openings(self, arm):
        """Openings and opening rates of the observed fingers."""
        if not arm.fingers:
            return np.zeros(N_OBSERVED_FINGERS), np.zeros(N_OBSERVED_FINGERS)
        arm.orient(self.position(arm.palm))
        offsets, velocities = self.finger_states(arm, self.velocity(arm.palm))
        return (offsets[:, 1] * arm.outward)[arm.observed], (velocities[:, 1] * arm.outward)[arm.observed]

    def hand_contacts(self):
        """The kinds of contact between hands (1), and between hands and the table (2), that press on each other."""
        if self.data.ncon == 0:
            return set()
        geoms = self.data.contact.geom
        kinds = self.contact_kinds[geoms[:, 0], geoms[:, 1]]
        if not kinds.any():
            return set()
        found, force = set(), np.zeros(6)
        for idx in np.flatnonzero(kinds):
            mujoco.mj_contactForce(self.model, self.data, idx, force)
            if force[0] > 0.0:
                found.add(int(kinds[idx]))
        return found

    def capsules(self, arm):
        """Position of the palm, ends of the capsules [5, 2, 3] and their Jacobians [5, 2, 3, 3]."""
        palm = self.position(arm.palm).copy()
        joints, jacobians, in_hand = arm.kinematics.points(arm.arm_from_world(palm))
        points = np.concatenate([arm.world_from_arm(joints), palm + arm.sign * in_hand])
        jacobians = arm.sign[:, None] * jacobians * arm.sign
        jacobians = np.concatenate([jacobians, np.tile(np.eye(3), (len(in_hand), 1, 1))])
        return palm, points[arm.kinematics.capsules], jacobians[arm.kinematics.capsules]
