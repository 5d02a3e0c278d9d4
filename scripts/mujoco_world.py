"""The simulated world of `tandem scene` in MuJoCo: bodies, the control law of the hands, and observations.

All numbers come from the output of `tandem scene --json`; docs/transfer.md lists what differs between the engines.
Vectors are in the world frame unless a name says otherwise; an arm's frame is the world frame shifted to the arm's
origin and, for the second of two arms, rotated by 180 degrees about z.
"""

from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np

ARM_ARM, ARM_TABLE = "arm-arm", "arm-table"


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


def cross(first, second):
    """The cross products of the last axes; numpy.cross takes three times as long for few vectors."""
    first, second = np.asarray(first), np.asarray(second)
    x, y, z = first[..., 0], first[..., 1], first[..., 2]
    a, b, c = second[..., 0], second[..., 1], second[..., 2]
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)


def bounded(values, limit):
    return np.minimum(np.maximum(values, -limit), limit)


def numbers(values):
    return " ".join(f"{value:.9g}" for value in np.atleast_1d(values))


def mjcf(world, contact):
    """Returns the MuJoCo model of `world` as MJCF.

    A body that cannot rotate has three slide joints along the world's axes; its shapes carry the rotation of its arm.
    Only the pairs of shapes that `world` lists collide, each with its own friction. Rapier integrates positions
    `solver_iterations` times per physics step under constant forces, and so does MuJoCo here.
    """
    signs = [arm["sign"] for arm in world["arms"]]

    def geom(idx, shape):
        turn = signs[shape["arm"]] if shape["body"] is not None and not world["bodies"][shape["body"]]["rotates"] else 1
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
        if description["rotates"]:
            joints = "<freejoint/>"
        else:
            joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
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


class Kinematics:
    """Forward and inverse kinematics of an arm whose gripper points down, in the frame of its base."""

    def __init__(self, parameters):
        self.parameters = parameters
        self.rows = parameters["dh_table"]
        self.directions = np.array([row["direction"] for row in self.rows])

    def frames(self, angles):
        """The axes [7, 3, 3] and origins [7, 3] of all frames, from base to tool."""
        axes, origins = [np.eye(3)], [np.zeros(3)]
        for row, angle in zip(self.rows, angles):
            turn = row["direction"] * angle + row["zero_rad"]
            sin, cos = np.sin(turn), np.cos(turn)
            sin_twist, cos_twist = row["sin_twist"], row["cos_twist"]
            step = np.array([row["length_m"] * cos, row["length_m"] * sin, row["offset_m"]])
            origins.append(origins[-1] + axes[-1] @ step)
            axes.append(
                axes[-1]
                @ np.array(
                    [
                        [cos, -sin * cos_twist, sin * sin_twist],
                        [sin, cos * cos_twist, -cos * sin_twist],
                        [0.0, sin_twist, cos_twist],
                    ]
                )
            )
        return np.array(axes), np.array(origins)

    def jacobian(self, axes, origins):
        """The geometric Jacobian of the tool, [6, 6]."""
        turns = axes[:6, :, 2] * self.directions[:, None]
        return np.concatenate([cross(turns, origins[6] - origins[:6]), turns], axis=1).T

    def joint_changes(self, jacobian, displacements):
        damped = jacobian @ jacobian.T + self.parameters["damping"] ** 2 * np.eye(6)
        return jacobian.T @ np.linalg.solve(damped, displacements)

    def solve(self, angles, target, n_iterations):
        """Joint angles near `angles` that bring the tool to `target`."""
        limit = self.parameters["max_angle_step_rad"]
        for _ in range(n_iterations):
            axes, origins = self.frames(angles)
            tool = axes[6]
            turn = 0.5 * cross(tool.T, [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]).sum(axis=0)
            error = np.concatenate([target - origins[6], turn])
            if error @ error < self.parameters["squared_error_tolerance"]:
                break
            angles = angles + bounded(self.joint_changes(self.jacobian(axes, origins), error), limit)
        return angles

    def points(self, angles, frames):
        """The origins of `frames`, [n, 3], and their Jacobians with respect to the tool's position, [n, 3, 3]."""
        axes, origins = self.frames(angles)
        rates = self.joint_changes(self.jacobian(axes, origins), np.eye(6)[:, :3])
        turns = axes[:6, :, 2] * self.directions[:, None]
        jacobians = [cross(turns[:frame], origins[frame] - origins[:frame]).T @ rates[:frame] for frame in frames]
        return origins[frames], np.array(jacobians)


class VelocityDamper:
    """Keeps the links of two arms apart by limiting the velocities of the palms."""

    def __init__(self, parameters):
        self.parameters = parameters
        n_links = len(parameters["link_radii_m"])
        radii = parameters["link_radii_m"] + [parameters["wrist_radius_m"], parameters["gripper_radius_m"]]
        pairs = [pair for pair in product(range(len(radii)), repeat=2) if min(pair) < n_links]
        self.pairs = np.array(pairs)
        self.radii_m = np.array([radii[first] + radii[second] for first, second in pairs])
        self.normals = np.full((len(pairs), 3), np.nan)
        self.min_gap_m = np.inf

    def update_posture(self, arms):
        """Takes the capsules of both arms at the start of a control step.

        `arms` has for each arm the palm's position, the ends of its capsules [5, 2, 3] and their Jacobians
        [5, 2, 3, 3].
        """
        self.palms = [palm for palm, _, _ in arms]
        self.ends = [ends[self.pairs[:, idx]] for idx, (_, ends, _) in enumerate(arms)]
        self.jacobians = [jacobians[self.pairs[:, idx]] for idx, (_, _, jacobians) in enumerate(arms)]
        self.active = np.arange(len(self.pairs))
        gaps, _, _ = self.proximity(self.palms)
        self.min_gap_m = gaps.min()
        self.active = np.flatnonzero(gaps < self.parameters["activation_distance_m"])

    def proximity(self, palms):
        """The gaps [n], normals [n, 3] and pairs of Jacobians [n, 3, 3] of the active pairs."""
        at = self.active
        ends = [self.ends[idx][at] + self.jacobians[idx][at] @ (palms[idx] - self.palms[idx]) for idx in range(2)]
        fractions = closest_fractions(*ends)
        points = [end[:, 0] + (end[:, 1] - end[:, 0]) * part[:, None] for end, part in zip(ends, fractions)]
        offset = points[0] - points[1]
        distance = np.linalg.norm(offset, axis=1)
        previous = self.normals[at]
        unknown = np.isnan(previous[:, 0])
        crossing = distance <= self.parameters["crossing_m"]
        normal = offset / np.maximum(distance, 1e-12)[:, None]
        reversed_ = (
            ~crossing
            & ~unknown
            & (distance < self.radii_m[at])
            & (np.einsum("ij,ij->i", normal, np.nan_to_num(previous)) < 0.0)
        )
        normal[reversed_] *= -1.0
        distance = np.where(reversed_, -distance, distance)
        normal[crossing] = np.where(unknown[crossing, None], [0.0, 0.0, 1.0], previous[crossing])
        distance[crossing] = 0.0
        self.normals[at] = normal
        jacobians = [
            self.jacobians[idx][at, 0] * (1.0 - part)[:, None, None] + self.jacobians[idx][at, 1] * part[:, None, None]
            for idx, part in enumerate(fractions)
        ]
        return distance - self.radii_m[at], normal, jacobians

    def limit(self, palms, velocities):
        if len(self.active) == 0:
            return velocities
        gaps, normals, jacobians = self.proximity(palms)
        self.min_gap_m = min(self.min_gap_m, gaps.min())
        near = np.flatnonzero(gaps < self.parameters["influence_distance_m"])
        if len(near) == 0:
            return velocities
        min_mps = np.minimum(-self.parameters["approach_gain_per_s"] * gaps[near], self.parameters["separation_mps"])
        return [
            self.project(np.einsum("nji,nj->ni", jacobians[idx][near], sign * normals[near]), min_mps, velocities[idx])
            for idx, sign in enumerate((1.0, -1.0))
        ]

    def project(self, directions, min_mps, velocity):
        """The velocity near `velocity` with `directions @ velocity >= min_mps`, or a scaled-down one."""
        floor = self.parameters["min_direction_norm"] ** 2
        for _ in range(self.parameters["max_projections"]):
            violations = min_mps - directions @ velocity
            worst = np.argmax(violations)
            if violations[worst] <= self.parameters["violation_tolerance_mps"]:
                return velocity
            direction = directions[worst]
            velocity = velocity + direction * (violations[worst] / max(direction @ direction, floor))
        speeds = directions @ velocity
        limited = (speeds < min_mps) & (speeds < 0.0)
        scales = np.minimum(min_mps[limited], 0.0) / speeds[limited]
        return velocity * min(1.0, scales.min(initial=1.0))


def closest_fractions(first, second):
    """The closest points of segments [n, 2, 3], as fractions of their lengths."""
    tiny = 1e-9
    along_first, along_second = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0]
    offset = first[:, 0] - second[:, 0]

    def dot(one, other):
        return np.einsum("ij,ij->i", one, other)

    a, e = dot(along_first, along_first), dot(along_second, along_second)
    b, c, f = dot(along_first, along_second), dot(along_first, offset), dot(along_second, offset)
    crossing = a * e - b * b
    s = np.where(crossing > tiny, np.clip((b * f - c * e) / np.maximum(crossing, tiny), 0.0, 1.0), 0.0)
    t = (b * s + f) / np.maximum(e, tiny)
    s = np.where(t < 0.0, np.clip(-c / np.maximum(a, tiny), 0.0, 1.0), s)
    s = np.where(t > 1.0, np.clip((b - c) / np.maximum(a, tiny), 0.0, 1.0), s)
    return s, np.clip(t, 0.0, 1.0)


class Arm:
    """One arm: its frame, the addresses of its bodies and the state of its kinematics."""

    def __init__(self, world, description, model):
        self.sign = np.array([description["sign"], description["sign"], 1.0])
        self.origin = np.array(description["origin_m"])
        self.fingers = description["fingers"]
        self.palm, self.object = (dof(model, description[part]) for part in ("palm", "object"))
        self.finger_dofs = np.array([dof(model, finger["body"]) for finger in self.fingers], dtype=int)
        self.finger_axes = self.finger_dofs[:, None] + np.arange(3)
        self.object_qpos = model.jnt_qposadr[model.body_jntadr[model.body(f"body{description['object']}").id]]
        self.closed_offsets = np.array([finger["closed_offset_m"] for finger in self.fingers])
        self.masses_kg = np.array([finger["mass_kg"] for finger in self.fingers])
        self.mass_fractions = np.array([finger["mass_fraction"] for finger in self.fingers])
        self.outward = np.array([finger["outward"] for finger in self.fingers])
        self.base = np.array(world["kinematics"]["base_in_arm_m"])

    def arm_from_world(self, point):
        return self.sign * (point - self.origin)

    def world_from_arm(self, point):
        return self.sign * point + self.origin

    def orientation_in_arm(self, wxyz):
        """A body's orientation in the arm's frame as (x, y, z, w) with w >= 0."""
        w, x, y, z = wxyz
        in_arm = np.array([x, y, z, w] if self.sign[0] > 0 else [-y, x, w, -z])
        return -in_arm if in_arm[3] < 0.0 else in_arm


def dof(model, body):
    """The address of a body's first degree of freedom."""
    return model.body_dofadr[model.body(f"body{body}").id]


class MujocoWorld:
    """The environment: reset to the start of a printed episode, observe, step."""

    def __init__(self, world, contact=ContactModel()):
        self.world, self.control, self.contact = world, world["hand"], contact
        self.model = mujoco.MjModel.from_xml_string(mjcf(world, contact))
        self.data = mujoco.MjData(self.model)
        self.arms = [Arm(world, description, self.model) for description in world["arms"]]
        self.kinematics = Kinematics(world["kinematics"])
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
            for idx, start in enumerate(arm.finger_dofs):
                self.position(start)[:] = palm + arm.closed_offsets[idx]
                self.position(start)[1] += arm.outward[idx] * numbers_of_arm[9 + idx]
            at = arm.object_qpos
            self.data.qpos[at : at + 3] = arm.world_from_arm(numbers_of_arm[3:6])
            self.data.qpos[at + 3 : at + 7] = [1.0, 0.0, 0.0, 0.0] if arm.sign[0] > 0 else [0.0, 0.0, 0.0, 1.0]
            home = np.array(self.world["kinematics"]["home_rad"])
            arm.angles = self.solve(arm, home, self.world["kinematics"]["reach_iterations"])
        self.damper = VelocityDamper(self.world["link_avoidance"]) if len(self.arms) == 2 else None
        if self.damper:
            self.damper.update_posture([self.capsules(arm) for arm in self.arms])
        mujoco.mj_forward(self.model, self.data)

    def observe(self):
        """The observation, shape [28 * n_arms], in the order of Env::observe."""
        per_step = self.world["control_step_s"]
        rows = []
        for arm in self.arms:
            palm, palm_velocity = self.position(arm.palm), self.velocity(arm.palm)
            at, start = arm.object_qpos, arm.object
            thing, quaternion = self.data.qpos[at : at + 3], self.data.qpos[at + 3 : at + 7]
            spin = np.zeros(3)
            mujoco.mju_rotVecQuat(spin, self.data.qvel[start + 3 : start + 6], quaternion)
            openings, rates = self.openings(arm)
            rows += [
                arm.arm_from_world(palm),
                arm.arm_from_world(thing),
                arm.sign * (thing - palm),
                openings,
                arm.orientation_in_arm(quaternion),
                arm.sign * (self.velocity(start) - palm_velocity) * per_step,
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
            arm.angles = self.solve(arm, arm.angles, self.world["kinematics"]["track_iterations"])
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
        at_in_arm = arm.arm_from_world(self.position(arm.palm)) + displacement * self.control["action_m"]
        return arm.world_from_arm(np.clip(at_in_arm, self.control["workspace_low_m"], self.control["workspace_high_m"]))

    def drive(self, targets, grippers):
        """Sets the forces on the hands for the next physics step."""
        palms = [self.position(arm.palm) for arm in self.arms]
        velocities = [(target - palm) * self.control["approach_gain_per_s"] for target, palm in zip(targets, palms)]
        if self.damper:
            velocities = self.damper.limit(palms, velocities)
        for arm, velocity, gripper in zip(self.arms, velocities, grippers):
            self.drive_hand(arm, velocity, gripper)

    def drive_hand(self, arm, velocity, gripper):
        control, forces = self.control, self.data.qfrc_applied
        step_s = self.world["control_step_s"] / self.world["substeps"]
        palm_velocity = self.velocity(arm.palm)
        limit = control["palm_force_n"]
        palm_force = bounded((velocity - palm_velocity) * (control["mass_kg"] / step_s), limit)
        forces[arm.palm : arm.palm + 3] = palm_force
        if not arm.fingers:
            return
        next_velocity = palm_velocity + palm_force * (step_s / control["mass_kg"])
        offsets, velocities = self.finger_states(arm, next_velocity)
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
        forces[arm.finger_axes] = held
        forces[arm.palm : arm.palm + 3] -= held.sum(axis=0)

    def finger_states(self, arm, palm_velocity):
        """Positions of the fingers relative to the closed ones, and velocities relative to the palm, [3, 3] each."""
        palm = self.position(arm.palm)
        positions = self.data.qpos[self.qpos_of_dof[arm.finger_axes]]
        return positions - palm - arm.closed_offsets, self.data.qvel[arm.finger_axes] - palm_velocity

    def openings(self, arm):
        if not arm.fingers:
            return np.zeros(3), np.zeros(3)
        offsets, velocities = self.finger_states(arm, self.velocity(arm.palm))
        return offsets[:, 1] * arm.outward, velocities[:, 1] * arm.outward

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

    def solve(self, arm, angles, n_iterations):
        tool = arm.arm_from_world(self.position(arm.palm)) - arm.base
        return self.kinematics.solve(angles, tool, n_iterations)

    def capsules(self, arm):
        """Position of the palm, ends of the capsules [5, 2, 3] and their Jacobians [5, 2, 3, 3]."""
        parameters = self.world["link_avoidance"]
        palm = self.position(arm.palm).copy()
        points, jacobians = self.kinematics.points(arm.angles, parameters["link_frames"])
        points = arm.world_from_arm(points + arm.base)
        jacobians = arm.sign[:, None] * jacobians * arm.sign
        wrist = [palm + [0.0, 0.0, above] for above in parameters["wrist_above_m"]]
        gripper = [palm + arm.sign * np.array(end) for end in parameters["gripper_ends_m"]]
        links = [[points[idx], points[idx + 1]] for idx in range(len(points) - 1)]
        link_jacobians = [[jacobians[idx], jacobians[idx + 1]] for idx in range(len(points) - 1)]
        with_palm = [[np.eye(3), np.eye(3)]]
        return palm, np.array([*links, wrist, gripper]), np.array(link_jacobians + 2 * with_palm)
