//! What a world looks like at one moment, for pictures and logs.

/// A point or direction in the world's frame, metres: origin in the middle of the table top, z up.
pub type Point = [f32; 3];

/// A bar with round ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capsule {
    /// One end of the axis.
    pub from: Point,
    /// The other end of the axis.
    pub to: Point,
    /// Radius, metres.
    pub radius_m: f32,
}

/// A box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cuboid {
    /// Its centre.
    pub centre: Point,
    /// Its orientation, quaternion (x, y, z, w).
    pub orientation: [f32; 4],
    /// Half its edges, metres.
    pub half_extents_m: [f32; 3],
}

/// One arm as drawn: links, hand and fingers.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmScene {
    /// Where the arm stands.
    pub base: Point,
    /// Joint angles, radians, base to wrist.
    pub joint_angles_rad: [f64; 6],
    /// Where the joints and at last the tool are, base first.
    pub joint_points: Vec<Point>,
    /// The links and the hand's wrist.
    pub links: Vec<Capsule>,
    /// Palm plate and finger pads.
    pub hand: Vec<Cuboid>,
    /// The centre between the finger pads.
    pub end_effector: Point,
}

/// Everything in a world.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Simulated time since the episode's start, seconds.
    pub time_s: f64,
    /// The arms, in order.
    pub arms: Vec<ArmScene>,
    /// The objects, one an arm, in arm order.
    pub objects: Vec<Cuboid>,
    /// Where the objects shall be, in arm order.
    pub goals: Vec<Point>,
    /// The table.
    pub table: Cuboid,
}
