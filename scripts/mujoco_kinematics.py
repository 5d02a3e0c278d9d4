"""Kinematics of the arms that hold the hands of `mujoco_world`, and the limit on velocities that keeps two arms apart.

Points and velocities are in an arm's own frame, unless a name says otherwise (`mujoco_world` describes the frames).
"""

import math
from itertools import product

import numpy as np

# Number of an arm's capsules that belong to its hand. The others are links.
N_HAND_CAPSULES = 2


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
