//! The continuous check: tool speed, reach, tilt and gaps, bounded over whole intervals between samples.
//!
//! A quantity with margin m in the middle of an interval of length h that changes by at most L per second keeps its
//! limit throughout the interval if m >= L h / 2. Otherwise both halves are checked, until L h / 2 is below the
//! tolerance (continuous collision checking by bisection). The rates L follow from bounds on the joints' velocities in
//! the interval and from levers: upper bounds, over all configurations, on the distance of any point of interest from a
//! joint's axis ([`ArmModel::link_levers_m`](crate::model::ArmModel::link_levers_m)).

use tandem_core::ArmIndex;

use super::settings::CheckSettings;
use crate::capsule::LinkCapsules;
use crate::forward::ForwardKinematics;
use crate::joints::Joints;
use crate::motion::Cubic;
use crate::refusal::{Excess, Reason, Refusal};
use crate::work_cell::{PlacedArm, WorkCell};

/// Tolerances between evaluations: of lengths (metres), of the tilt (radians), of the tool's speed (metres per second).
const LENGTH_TOLERANCE_M: f64 = 1e-4;
const TILT_TOLERANCE_RAD: f64 = 0.1 * std::f64::consts::PI / 180.0;
const SPEED_TOLERANCE_MPS: f64 = 2e-3;

/// The check of one interval after the other.
pub(super) struct ContinuousCheck<'a> {
    cell: &'a WorkCell,
    settings: &'a CheckSettings,
    arms: Vec<ArmInterval>,
}

/// The motion of one arm in the current interval.
struct ArmInterval {
    cubics: Vec<Cubic>,
    /// Largest gripper opening, 0 to 1.
    gripper_opening: f64,
    tool_levers_m: Joints,
    link_levers_m: Joints,
    rates: RateBounds,
}

/// Upper bounds on rates of change, per second.
#[derive(Default)]
struct RateBounds {
    /// Of the tool's speed, metres per second squared.
    tool_speed: f64,
    /// Of the distance between tool and shoulder, metres per second.
    reach: f64,
    /// Of the gripper's tilt, radians per second.
    tilt: f64,
    /// Of the height of any part, and of distances between parts of the arm, metres per second.
    height: f64,
    /// Of the position of any part, metres per second.
    position: f64,
}

/// A quantity at one time: its value, its limit, and how much of its change may go unnoticed.
struct Quantity {
    got: f64,
    allowed: f64,
    /// Upper bound on its rate of change, per second.
    per_s: f64,
    tolerance: f64,
}

/// The result of evaluating all quantities in the middle of an interval.
struct Evaluation {
    half_s: f64,
    /// The first limit that is violated there.
    violated: Option<(ArmIndex, Reason)>,
    /// `true` if a limit may be violated elsewhere in the interval.
    undecided: bool,
}

impl<'a> ContinuousCheck<'a> {
    pub(super) fn new(cell: &'a WorkCell, settings: &'a CheckSettings) -> Self {
        let interval = |arm: &PlacedArm| ArmInterval {
            cubics: Vec::new(),
            gripper_opening: 1.0,
            tool_levers_m: arm.model.tool_levers_m(),
            link_levers_m: arm.model.link_levers_m(),
            rates: RateBounds::default(),
        };
        Self { cell, settings, arms: cell.arms.iter().map(interval).collect() }
    }

    /// Sets the motion of `arm` in the next interval and the largest opening of its gripper.
    pub(super) fn set_interval(&mut self, arm: ArmIndex, cubics: Vec<Cubic>, gripper_opening: f64) {
        let interval = &mut self.arms[arm.0];
        (interval.cubics, interval.gripper_opening) = (cubics, gripper_opening);
        interval.rates = interval.rate_bounds();
    }

    /// Checks the interval of `period_s` that begins at `when_s`.
    pub(super) fn check(&self, when_s: f64, period_s: f64) -> Result<(), Refusal> {
        self.bisect(when_s, [0.0, period_s])
    }

    /// Checks a part of the interval, given in seconds since its start.
    fn bisect(&self, when_s: f64, [from_s, to_s]: [f64; 2]) -> Result<(), Refusal> {
        let middle_s = 0.5 * (from_s + to_s);
        let evaluation = self.evaluate(middle_s, 0.5 * (to_s - from_s));
        if evaluation.undecided {
            self.bisect(when_s, [from_s, middle_s])?;
            return self.bisect(when_s, [middle_s, to_s]);
        }
        match evaluation.violated {
            Some((arm, reason)) => Err(reason.at(arm, when_s + middle_s)),
            None => Ok(()),
        }
    }

    fn evaluate(&self, at_s: f64, half_s: f64) -> Evaluation {
        let mut evaluation = Evaluation { half_s, violated: None, undecided: false };
        let mut placed_links: Vec<LinkCapsules> = Vec::with_capacity(self.arms.len());
        for (arm, placed) in self.cell.indexed() {
            let interval = &self.arms[arm.0];
            let angles = interval.joints(|cubic| cubic.angle(at_s));
            let forward = ForwardKinematics::new(placed.model, &angles);
            let velocities = interval.joints(|cubic| cubic.rate(at_s));
            self.evaluate_tool(&mut evaluation, arm, &forward, &velocities);
            let links = placed.capsules(&forward);
            self.evaluate_table(&mut evaluation, arm, &links);
            self.evaluate_self(&mut evaluation, arm, &links);
            for (other, other_links) in placed_links.iter().enumerate() {
                let arms = [ArmIndex(other), arm];
                self.evaluate_between(&mut evaluation, arms, [other_links, &links]);
            }
            placed_links.push(links);
        }
        evaluation
    }

    fn evaluate_tool(
        &self,
        evaluation: &mut Evaluation,
        arm: ArmIndex,
        forward: &ForwardKinematics,
        velocities: &Joints,
    ) {
        let (settings, model) = (self.settings, self.cell.arms[arm.0].model);
        let rates = &self.arms[arm.0].rates;
        let speed = Quantity {
            got: forward.tool_velocity(velocities).norm(),
            allowed: settings.limits.tool_speed_mps,
            per_s: rates.tool_speed,
            tolerance: SPEED_TOLERANCE_MPS,
        };
        evaluation.at_most(arm, &speed, Reason::ToolSpeed);
        let reach = Quantity {
            got: (forward.tool_m() - model.shoulder_m()).norm(),
            allowed: settings.reach_share * model.reach_m(),
            per_s: rates.reach,
            tolerance: LENGTH_TOLERANCE_M,
        };
        evaluation.at_most(arm, &reach, Reason::Reach);
        let tilt = Quantity {
            got: forward.tilt_rad(),
            allowed: settings.tilt_rad,
            per_s: rates.tilt,
            tolerance: TILT_TOLERANCE_RAD,
        };
        evaluation.at_most(arm, &tilt, Reason::Tilt);
    }

    fn evaluate_table(&self, evaluation: &mut Evaluation, arm: ArmIndex, links: &LinkCapsules) {
        let (gap_m, link) = links.table_gap_m(self.cell.table_z_m);
        let name = self.cell.arms[arm.0].model.links[link].name;
        let gap = Quantity::gap(gap_m, self.settings.table_gap_m, self.arms[arm.0].rates.height);
        evaluation.at_least(arm, &gap, |excess| Reason::TableGap(name, excess));
    }

    /// Evaluates the gaps within one arm. Joint 1 moves all its parts together, so distances between parts change no
    /// faster than heights.
    fn evaluate_self(&self, evaluation: &mut Evaluation, arm: ArmIndex, links: &LinkCapsules) {
        let (model, interval) = (self.cell.arms[arm.0].model, &self.arms[arm.0]);
        let (gap_m, nearest) = links.self_gap_m(model, interval.gripper_opening);
        let names = nearest.map(|link| model.links[link].name);
        let gap = Quantity::gap(gap_m, self.settings.self_gap_m, interval.rates.height);
        evaluation.at_least(arm, &gap, |excess| Reason::SelfGap(names, excess));
    }

    fn evaluate_between(
        &self,
        evaluation: &mut Evaluation,
        arms: [ArmIndex; 2],
        links: [&LinkCapsules; 2],
    ) {
        let (gap_m, nearest) = links[0].gap_m(links[1]);
        let rates = arms.map(|arm| self.arms[arm.0].rates.position);
        let names: [&'static str; 2] = std::array::from_fn(|side| {
            self.cell.arms[arms[side].0].model.links[nearest[side]].name
        });
        let gap = Quantity::gap(gap_m, self.settings.arms_gap_m, rates[0] + rates[1]);
        evaluation.at_least(arms[0], &gap, |excess| Reason::ArmsGap(arms[1], names, excess));
    }
}

impl Quantity {
    fn gap(got: f64, allowed: f64, per_s: f64) -> Self {
        Self { got, allowed, per_s, tolerance: LENGTH_TOLERANCE_M }
    }
}

impl Evaluation {
    fn at_most(&mut self, arm: ArmIndex, of: &Quantity, reason: impl FnOnce(Excess) -> Reason) {
        self.note(arm, of.allowed - of.got, of, reason);
    }

    fn at_least(&mut self, arm: ArmIndex, of: &Quantity, reason: impl FnOnce(Excess) -> Reason) {
        self.note(arm, of.got - of.allowed, of, reason);
    }

    /// A margin that exceeds the largest possible change is sufficient for the whole interval. A smaller one leaves the
    /// interval undecided until the possible change is within the tolerance; the limit is then violated if the margin
    /// is negative.
    fn note(
        &mut self,
        arm: ArmIndex,
        margin: f64,
        of: &Quantity,
        reason: impl FnOnce(Excess) -> Reason,
    ) {
        let change = of.per_s * self.half_s;
        if margin >= change - of.tolerance {
            return;
        }
        self.undecided |= change > of.tolerance;
        if margin < 0.0 && self.violated.is_none() {
            self.violated = Some((arm, reason(Excess { got: of.got, allowed: of.allowed })));
        }
    }
}

impl ArmInterval {
    fn joints(&self, value: impl Fn(&Cubic) -> f64) -> Joints {
        Joints::from_fn(self.cubics.len(), |joint| value(&self.cubics[joint]))
    }

    fn rate_bounds(&self) -> RateBounds {
        let velocities = self.joints(Cubic::rate_bound);
        let accelerations = self.joints(Cubic::largest_acceleration);
        let last = velocities.len() - 1;
        let mut bounds = RateBounds::default();
        for (joint, velocity) in velocities.iter().enumerate() {
            let (tool_m, link_m) = (self.tool_levers_m[joint], self.link_levers_m[joint]);
            bounds.position += link_m * velocity;
            // Joint 1 has a vertical axis, so it changes no height; the shoulder lies on the axes of joints 1 and 2.
            bounds.height += if joint > 0 { link_m * velocity } else { 0.0 };
            bounds.reach += if joint > 1 { tool_m * velocity } else { 0.0 };
            // The last joint rotates about the gripper's direction.
            bounds.tilt += if joint > 0 && joint < last { *velocity } else { 0.0 };
            bounds.tool_speed += tool_m * accelerations[joint];
            for (other, other_velocity) in velocities.iter().enumerate() {
                let lever_m = self.tool_levers_m[joint.max(other)];
                bounds.tool_speed += lever_m * velocity * other_velocity;
            }
        }
        bounds
    }
}
