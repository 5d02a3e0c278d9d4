"""The simulated world of `tandem scene` in MuJoCo: bodies, the control law of the hands, and observations.

All numbers come from the output of `tandem scene --json`; docs/transfer.md lists what differs between the engines.
Vectors are in the world frame unless a name says otherwise; an arm's frame is the world frame shifted to the arm's
origin and, for the second of two arms, rotated by 180 degrees about z. A palm's frame has its origin at the end
effector; fingers close along y, and the hand points along -z. It is parallel to the arm's frame if the hand is upright.
"""

import math
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np

ARM_ARM, ARM_TABLE = "arm-arm", "arm-table"
# Number of fingers in an observation.
N_OBSERVED_FINGERS = 3
# Number of an arm's capsules that belong to its hand. The others are links.
N_HAND_CAPSULES = 2


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


def cross(first, second):
    """The cross products of the last axes; numpy.cross takes three times as long for few vectors."""
    first, second = np.asarray(first), np.asarray(second)
    x, y, z = first[..., 0], first[..., 1], first[..., 2]
    a, b, c = second[..., 0], second[..., 1], second[..., 2]
    products = np.empty(np.broadcast_shapes(first.shape, second.shape))
    products[..., 0], products[..., 1], products[..., 2] = y * c - z * b, z * a - x * c, x * b - y * a
    return products


def bounded(values, limit):
    return np.minimum(np.maximum(values, -limit), limit)


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


class Jaco:
    """The kinematics of an arm whose gripper points down: joint angles by iteration, in the frame of its base."""

    # The ends of the capsules among the points that `points` returns.
    capsules = np.array([[0, 1], [1, 2], [2, 3], [4, 5], [6, 7]])

    def __init__(self, parameters, avoidance):
        self.parameters = parameters
        self.base = np.array(parameters["base_in_arm_m"])
        self.rows = parameters["dh_table"]
        self.directions = np.array([row["direction"] for row in self.rows])
        self.link_frames = avoidance["link_frames"]
        wrist = [[0.0, 0.0, above] for above in avoidance["wrist_above_m"]]
        self.hand_points = np.array(wrist + avoidance["gripper_ends_m"])
        self.radii_m = avoidance["link_radii_m"] + [avoidance["wrist_radius_m"], avoidance["gripper_radius_m"]]

    def start(self, at):
        """Finds joint angles for the end effector at `at` (arm's frame) from the home posture."""
        self.angles = self.solve(np.array(self.parameters["home_rad"]), at, self.parameters["reach_iterations"])

    def track(self, at):
        self.angles = self.solve(self.angles, at, self.parameters["track_iterations"])

    def motion(self, _at, _velocity):
        """The orientation of the hand [3, 3] and its angular velocity, arm's frame."""
        return np.eye(3), np.zeros(3)

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

    def solve(self, angles, at, n_iterations):
        """Joint angles near `angles` that bring the tool to `at`, arm's frame."""
        target, limit = at - self.base, self.parameters["max_angle_step_rad"]
        for _ in range(n_iterations):
            axes, origins = self.frames(angles)
            tool = axes[6]
            turn = 0.5 * cross(tool.T, [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]).sum(axis=0)
            error = np.concatenate([target - origins[6], turn])
            if error @ error < self.parameters["squared_error_tolerance"]:
                break
            angles = angles + bounded(self.joint_changes(self.jacobian(axes, origins), error), limit)
        return angles

    def points(self, _at):
        """The ends of the links [n, 3] in the arm's frame, their Jacobians with respect to the end effector [n, 3, 3],
        and the ends of the hand's capsules relative to the end effector.
        """
        axes, origins = self.frames(self.angles)
        rates = self.joint_changes(self.jacobian(axes, origins), np.eye(6)[:, :3])
        turns = axes[:6, :, 2] * self.directions[:, None]
        jacobians = [
            cross(turns[:frame], origins[frame] - origins[:frame]).T @ rates[:frame] for frame in self.link_frames
        ]
        return origins[self.link_frames] + self.base, np.array(jacobians), self.hand_points


class Mico:
    """The kinematics of an arm with four joints, whose hand tilts, in closed form and in the arm's frame.

    Upper arm and forearm lie in the vertical plane through the base's axis and the end effector, with the elbow up, and
    the hand continues the forearm. The fingers close as nearly along y as its tilt permits.
    """

    # The ends of the capsules among the points that `points` returns: base, shoulder, elbow, wrist, then the hand's.
    capsules = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [5, 6]])

    def __init__(self, parameters, avoidance):
        self.shoulder = parameters["shoulder_in_arm_m"]
        self.upper_m, self.forearm_m = parameters["upper_arm_m"], parameters["forearm_m"]
        self.reach_m = parameters["elbow_to_end_effector_m"]
        self.most_cos = math.sqrt(1.0 - parameters["min_sin_bend"] ** 2)
        self.hand_points = np.array([avoidance["shell_end_m"], *avoidance["finger_ends_m"]])
        self.radii_m = avoidance["radii_m"]

    def start(self, at):
        """Nothing: the posture depends on the position of the end effector only."""

    def track(self, at):
        """Nothing."""

    def motion(self, at, velocity):
        """The orientation of the hand [3, 3] and its angular velocity with the end effector at `at`."""
        posture = MicoPosture(self, at)
        return posture.orientation(), posture.angular_velocity(velocity)

    def points(self, at):
        """The joints [4, 3], their Jacobians with respect to the end effector [4, 3, 3], and the ends of the hand's
        capsules relative to the end effector.
        """
        posture = MicoPosture(self, at)
        shoulder = np.array(self.shoulder)
        # The base is at the height of the table, on the axis through the shoulder.
        base = shoulder * [1.0, 1.0, 0.0]
        elbow = posture.along(posture.upper) * self.upper_m
        wrist = elbow + posture.along(posture.fore) * self.forearm_m
        jacobians = [np.zeros((3, 3)), np.zeros((3, 3)), posture.jacobian(elbow, 0.0)]
        jacobians.append(posture.jacobian(wrist, self.forearm_m))
        points = np.array([base, shoulder, shoulder + elbow, shoulder + wrist])
        return points, np.array(jacobians), self.hand_points @ posture.orientation().T


class MicoPosture:
    """A Mico with its end effector at a position. Directions in its plane are sine and cosine of the angle from z."""

    def __init__(self, mico, at):
        self.mico = mico
        x, y, z = (float(part) - origin for part, origin in zip(at, mico.shoulder))
        self.radius_m = max(math.hypot(x, y), 1e-3)
        self.ahead = (x / self.radius_m, y / self.radius_m)
        upper_m, fore_m, distance_m = mico.upper_m, mico.reach_m, math.hypot(self.radius_m, z)
        cos_bend = (distance_m**2 - upper_m**2 - fore_m**2) / (2.0 * upper_m * fore_m)
        cos_bend = min(max(cos_bend, -mico.most_cos), mico.most_cos)
        self.sin_bend = math.sqrt(1.0 - cos_bend**2)
        upper_rad = math.atan2(self.radius_m, z) - math.atan2(fore_m * self.sin_bend, upper_m + fore_m * cos_bend)
        fore_rad = upper_rad + math.acos(cos_bend)
        self.upper = (math.sin(upper_rad), math.cos(upper_rad))
        self.fore = (math.sin(fore_rad), math.cos(fore_rad))

    def orientation(self):
        """The orientation of the hand, whose columns are its axes."""
        x, y, z = self.up()
        closing_y = math.sqrt(1.0 - y * y)
        return np.array(
            [
                [z / closing_y, -x * y / closing_y, x],
                [0.0, closing_y, y],
                [-x / closing_y, -z * y / closing_y, z],
            ]
        )

    def angular_velocity(self, velocity):
        """The angular velocity of the hand while the end effector moves with `velocity`."""
        (cos_azimuth, sin_azimuth), (sin, cos) = self.ahead, self.fore
        x, y, z = self.up()
        velocity_x, velocity_y, velocity_z = map(float, velocity)
        _, (fore_ahead, fore_up) = self.angle_rates()
        tilt = fore_ahead * (velocity_x * cos_azimuth + velocity_y * sin_azimuth) + fore_up * velocity_z
        turn = sin * (velocity_y * cos_azimuth - velocity_x * sin_azimuth) / self.radius_m
        # How the hand's z axis moves.
        rate_x = turn * sin_azimuth - tilt * cos * cos_azimuth
        rate_y = -turn * cos_azimuth - tilt * cos * sin_azimuth
        rate_z = tilt * sin
        # The fingers stay as near to y as they can.
        spin = y * (z * rate_x - x * rate_z) / (1.0 - y * y)
        return np.array(
            [
                y * rate_z - z * rate_y + x * spin,
                z * rate_x - x * rate_z + y * spin,
                x * rate_y - y * rate_x + z * spin,
            ]
        )

    def jacobian(self, point, forearm_m):
        """The Jacobian of a point, relative to the shoulder and `forearm_m` beyond the elbow, with respect to the end
        effector.
        """
        cos_azimuth, sin_azimuth = self.ahead
        ahead, aside = np.array([cos_azimuth, sin_azimuth, 0.0]), np.array([-sin_azimuth, cos_azimuth, 0.0])
        by_ahead, by_up = (
            self.across(self.upper) * (self.mico.upper_m * upper) + self.across(self.fore) * (forearm_m * fore)
            for upper, fore in zip(*self.angle_rates())
        )
        by_aside = aside * (point @ ahead / self.radius_m)
        return np.outer(by_ahead, ahead) + np.outer(by_up, [0.0, 0.0, 1.0]) + np.outer(by_aside, aside)

    def angle_rates(self):
        """How the angles of upper arm and forearm change per displacement of the end effector ahead and up, rad/m."""
        (sin_upper, cos_upper), (sin_fore, cos_fore) = self.upper, self.fore
        upper, fore = 1.0 / (self.mico.upper_m * self.sin_bend), 1.0 / (self.mico.reach_m * self.sin_bend)
        return (sin_fore * upper, cos_fore * upper), (-sin_upper * fore, -cos_upper * fore)

    def up(self):
        """The hand's z axis, against the direction in which it points."""
        (cos_azimuth, sin_azimuth), (sin, cos) = self.ahead, self.fore
        return -cos_azimuth * sin, -sin_azimuth * sin, -cos

    def along(self, direction):
        """The unit vector of a direction in the arm's plane."""
        (cos_azimuth, sin_azimuth), (sin, cos) = self.ahead, direction
        return np.array([cos_azimuth * sin, sin_azimuth * sin, cos])

    def across(self, direction):
        """The derivative of `along` with respect to the angle."""
        (cos_azimuth, sin_azimuth), (sin, cos) = self.ahead, direction
        return np.array([cos_azimuth * cos, sin_azimuth * cos, -sin])


class VelocityDamper:
    """Keeps the links of two arms apart by limiting the velocities of the palms."""

    def __init__(self, parameters, radii):
        self.parameters = parameters
        n_links = len(radii) - N_HAND_CAPSULES
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
        """The gaps [n], normals [n, 3] and closest points, as pairs of fractions [n], of the active pairs."""
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
            ~crossing & ~unknown & (distance < self.radii_m[at]) & (np.einsum("ij,ij->i", normal, previous) < 0.0)
        )
        normal[reversed_] *= -1.0
        distance = np.where(reversed_, -distance, distance)
        normal[crossing] = np.where(unknown[crossing, None], [0.0, 0.0, 1.0], previous[crossing])
        distance[crossing] = 0.0
        self.normals[at] = normal
        return distance - self.radii_m[at], normal, fractions

    def limit(self, palms, velocities):
        if len(self.active) == 0:
            return velocities
        gaps, normals, fractions = self.proximity(palms)
        self.min_gap_m = min(self.min_gap_m, gaps.min())
        near = np.flatnonzero(gaps < self.parameters["influence_distance_m"])
        if len(near) == 0:
            return velocities
        min_mps = np.minimum(-self.parameters["approach_gain_per_s"] * gaps[near], self.parameters["separation_mps"])
        limited = []
        for idx, sign in enumerate((1.0, -1.0)):
            part, ends = fractions[idx][near, None, None], self.jacobians[idx][self.active[near]]
            jacobians = ends[:, 0] * (1.0 - part) + ends[:, 1] * part
            directions = np.einsum("nji,nj->ni", jacobians, sign * normals[near])
            limited.append(self.project(directions, min_mps, velocities[idx]))
        return limited

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
    """One arm: its frame, the addresses of its bodies, its kinematics and the motion of its hand."""

    def __init__(self, world, description, model):
        self.sign = np.array([description["sign"], description["sign"], 1.0])
        self.origin = np.array(description["origin_m"])
        self.fingers = description["fingers"]
        self.palm, self.object = (dof(model, description[part]) for part in ("palm", "object"))
        self.finger_dofs = np.array([dof(model, finger["body"]) for finger in self.fingers], dtype=int)
        self.finger_axes = self.finger_dofs[:, None] + np.arange(3)
        self.object_qpos = model.jnt_qposadr[model.body_jntadr[model.body(f"body{description['object']}").id]]
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
        in_arm = np.array([x, y, z, w] if self.sign[0] > 0 else [-y, x, w, -z])
        return -in_arm if in_arm[3] < 0.0 else in_arm

    def orientation_in_world(self, xyzw):
        """A body's orientation as (w, x, y, z), from that in the arm's frame."""
        x, y, z, w = xyzw
        return [w, x, y, z] if self.sign[0] > 0 else [-z, -y, x, w]


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
            self.data.qpos[at : at + 3] = arm.world_from_arm(numbers_of_arm[3:6])
            self.data.qpos[at + 3 : at + 7] = arm.orientation_in_world(numbers_of_arm[12:16])
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
