//! The constants in which the worlds differ.

use rapier3d::math::Vector;
use tandem_core::World;

use crate::hand::{HandGeometry, MICO_HAND, THREE_FINGERS};
use crate::reach::Reach;

/// A kind of arm, which moves a hand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ArmKind {
    /// Kinova's Jaco with six joints. Its hand points straight down.
    Jaco,
    /// Kinova's Mico with four joints. Its hand tilts.
    Mico,
}

/// The constants of a world.
#[derive(Debug)]
pub(crate) struct WorldParameters {
    /// Control steps per second of simulated time.
    pub(crate) control_steps_per_s: f64,
    /// Proportional gain from the palm's distance to its target to its velocity, 1/s.
    pub(crate) approach_gain_per_s: f32,
    /// Largest speed of the palm, metres per second.
    pub(crate) max_speed_mps: Option<f32>,
    /// The kind of arms.
    pub(crate) arms: ArmKind,
    /// Position of the arm's base, arm frame, metres: at the height of the table.
    pub(crate) base_in_arm: Vector,
    /// Lower corner of the end effector's workspace, arm frame, metres.
    pub(crate) workspace_low: Vector,
    /// Upper corner of the end effector's workspace, arm frame, metres.
    pub(crate) workspace_high: Vector,
    /// The part of this box that the arm reaches; all of it if there is none.
    pub(crate) reach: Option<&'static Reach>,
    /// Fingers and pads.
    pub(crate) gripper: &'static HandGeometry,
    /// Largest force of the palm's servo along each axis, newtons.
    pub(crate) palm_force_n: f32,
    /// Force on an object from above, newtons, that counts as a contact with the table, if any does. Arms whose torques are
    /// supervised stop at such a force.
    pub(crate) press_limit_n: Option<f32>,
    /// Whether contacts with the table say which arm touched it.
    pub(crate) attributes_contacts: bool,
}

static CLASSIC: WorldParameters = WorldParameters {
    control_steps_per_s: 25.0,
    approach_gain_per_s: 27.0,
    max_speed_mps: None,
    arms: ArmKind::Jaco,
    base_in_arm: Vector::new(-0.40, 0.0, 0.0),
    workspace_low: Vector::new(-0.20, -0.25, 0.022),
    workspace_high: Vector::new(0.20, 0.25, 0.35),
    reach: None,
    gripper: &THREE_FINGERS,
    palm_force_n: 40.0,
    press_limit_n: None,
    attributes_contacts: false,
};

/// The gain covers 91 % of a displacement of 5 cm within a control step, and 98 % of a short one. The workspace's floor
/// keeps the pads 16 mm above the table, where the Mico holds them. Its extent along x and y leaves room for the hand
/// behind an object at the edge of the objects' area.
static SHARED: WorldParameters = WorldParameters {
    control_steps_per_s: 4.0,
    approach_gain_per_s: 16.0,
    max_speed_mps: Some(0.2),
    arms: ArmKind::Mico,
    base_in_arm: Vector::new(-World::Shared.mico_base_distance_m(), 0.0, 0.0),
    workspace_low: Vector::new(-0.06, -0.22, 0.031),
    workspace_high: Vector::new(0.27, 0.22, 0.33),
    reach: Some(&Reach::MICO),
    gripper: &MICO_HAND,
    palm_force_n: 40.0,
    press_limit_n: Some(10.0),
    attributes_contacts: true,
};

/// A step covers the same share of a displacement as in the classic world, so a policy of that world can act here. Two
/// hands that hold one bar disagree: the servo's force is below what two pads hold by friction, so that a palm gives way
/// before its pads slip.
static SLOW: WorldParameters = WorldParameters {
    control_steps_per_s: 4.0,
    approach_gain_per_s: 4.32,
    max_speed_mps: Some(0.2),
    arms: ArmKind::Jaco,
    base_in_arm: CLASSIC.base_in_arm,
    workspace_low: CLASSIC.workspace_low,
    workspace_high: CLASSIC.workspace_high,
    reach: None,
    gripper: &THREE_FINGERS,
    palm_force_n: 10.0,
    press_limit_n: None,
    attributes_contacts: false,
};

impl WorldParameters {
    pub(crate) fn of(world: World) -> &'static Self {
        match world {
            World::Classic => &CLASSIC,
            World::Shared => &SHARED,
            World::Slow => &SLOW,
        }
    }

    /// Returns the nearest position to `end_effector` (arm frame, metres) along each axis, and then along the radius
    /// from the base, that the end effector may have.
    pub(crate) fn clamp(&self, end_effector: Vector) -> Vector {
        let in_box = end_effector.clamp(self.workspace_low, self.workspace_high);
        self.reach.map_or(in_box, |reach| reach.clamp(in_box))
    }

    /// Returns true if the end effector may be at `end_effector`, arm frame, metres.
    pub(crate) fn contains(&self, end_effector: Vector) -> bool {
        self.clamp(end_effector) == end_effector
    }

    /// Limits the speed of `velocity`, metres per second.
    pub(crate) fn limit_speed(&self, velocity: Vector) -> Vector {
        self.max_speed_mps.map_or(velocity, |most| velocity.clamp_length_max(most))
    }
}
