//! A snapshot of a simulated world, or of real arms, for pictures and logs.

/// A point in the world frame, metres. The origin is the centre of the table top, and z points up.
pub type Point = [f32; 3];

/// A cylinder with hemispherical ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capsule {
    /// One end of the axis.
    pub from: Point,
    /// The other end of the axis.
    pub to: Point,
    /// Radius, metres.
    pub radius_m: f32,
}

/// A box with any orientation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cuboid {
    /// Its centre.
    pub centre: Point,
    /// Its orientation in the world frame, quaternion (x, y, z, w).
    pub orientation: [f32; 4],
    /// Half the lengths of its edges, metres.
    pub half_extents_m: [f32; 3],
}

/// One arm: links, hand and fingers.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmScene {
    /// The origin of the arm's base frame.
    pub base: Point,
    /// Joint angles, radians, from base to wrist; 0 beyond the joints that the arm has.
    pub joint_angles_rad: [f64; 6],
    /// Positions of the base, the joints and the tool or end effector, in this order.
    pub joint_points: Vec<Point>,
    /// The links and the wrist.
    pub links: Vec<Capsule>,
    /// The palm plate, or the shell of the hand, and the fingers.
    pub hand: Vec<Cuboid>,
    /// The centre between the finger pads; in scenes of a work cell the tool's origin, 2 cm behind it.
    pub end_effector: Point,
}

/// All bodies of a world at one moment.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Time since the start of the episode or of the motion, seconds.
    pub time_s: f64,
    /// The arms, in order.
    pub arms: Vec<ArmScene>,
    /// The objects, one per arm, in arm order. Of an object that the arms share, these are its parts: first the one
    /// that each arm brings to its goal, then the others.
    pub objects: Vec<Cuboid>,
    /// Goal positions of the objects, in arm order; empty if there are no objects.
    pub goals: Vec<Point>,
    /// Distance of an object from its goal up to which the goal counts as achieved, metres; 0 without goals.
    pub goal_tolerance_m: f32,
    /// The table.
    pub table: Cuboid,
}
