//! What the arms sweep between two samples: tool speed, reach, tilt and gaps, bounded over the whole interval.
//!
//! A quantity that has a margin m in the middle of an interval of length h and changes by at most L per second keeps
//! its limit throughout when m >= L h / 2. If not, both halves are looked at, until L h / 2 is below the tolerance.
//! The rates L come from bounds on the joints' rates in the interval and from levers: the largest distance that any
//! point of interest can have from a joint's axis, whatever the posture ([`ArmModel::tool_levers_m`]).

use tandem_core::ArmIndex;

use crate::capsule::PosedLinks;
use crate::check::CheckSettings;
use crate::forward::ForwardKinematics;
use crate::joints::Joints;
use crate::motion::Cubic;
use crate::refusal::{Excess, Reason, Refusal};
use crate::work_cell::{PlacedArm, WorkCell};

/// What may hide between the looks: of lengths (metres), of the tilt (radians), of the tool's speed (m/s).
const LENGTH_TOLERANCE_M: f64 = 1e-4;
const TILT_TOLERANCE_RAD: f64 = 0.1 * std::f64::consts::PI / 180.0;
const SPEED_TOLERANCE_MPS: f64 = 2e-3;

/// The arms' motion in one interval after the other.
pub(crate) struct Sweep<'a> {
    cell: &'a WorkCell,
    settings: &'a CheckSettings,
    arms: Vec<Swept>,
}

/// One arm in the present interval.
struct Swept {
    cubics: Vec<Cubic>,
    /// How far the gripper is open at most, 0 to 1.
    gripper_opening: f64,
    tool_levers_m: Joints,
    link_levers_m: Joints,
    change: Change,
}

/// How fast things change at most, per second.
#[derive(Default)]
struct Change {
    tool_speed: f64,
    reach: f64,
    tilt: f64,
    height: f64,
    place: f64,
}

/// What one look at the middle of an interval brought.
struct Look {
    half_s: f64,
    /// A limit that is broken there.
    broken: Option<(ArmIndex, Reason)>,
    /// Whether anything may be broken elsewhere in the interval.
    unsettled: bool,
}

impl<'a> Sweep<'a> {
    pub(crate) fn new(cell: &'a WorkCell, settings: &'a CheckSettings) -> Self {
        let swept = |arm: &PlacedArm| Swept {
            cubics: Vec::new(),
            gripper_opening: 1.0,
            tool_levers_m: arm.model.tool_levers_m(),
            link_levers_m: arm.model.link_levers_m(),
            change: Change::default(),
        };
        Self { cell, settings, arms: cell.arms.iter().map(swept).collect() }
    }

    /// Takes over the joints' motion of `arm` in the interval to be checked, and how far its gripper is open at most.
    pub(crate) fn follow(&mut self, arm: ArmIndex, cubics: Vec<Cubic>, gripper_opening: f64) {
        let swept = &mut self.arms[arm.0];
        (swept.cubics, swept.gripper_opening) = (cubics, gripper_opening);
        swept.change = swept.changes();
    }

    /// Checks the interval of `period_s` that begins at `when_s`.
    pub(crate) fn check(&self, when_s: f64, period_s: f64) -> Result<(), Refusal> {
        self.first_broken(when_s, [0.0, period_s])
    }

    /// Looks at a part of the interval, given in seconds since its start: the first half first.
    fn first_broken(&self, when_s: f64, [from_s, to_s]: [f64; 2]) -> Result<(), Refusal> {
        let middle_s = 0.5 * (from_s + to_s);
        let look = self.look(middle_s, 0.5 * (to_s - from_s));
        if look.unsettled {
            self.first_broken(when_s, [from_s, middle_s])?;
            return self.first_broken(when_s, [middle_s, to_s]);
        }
        match look.broken {
            Some((arm, reason)) => Err(reason.of(arm, when_s + middle_s)),
            None => Ok(()),
        }
    }

    fn look(&self, at_s: f64, half_s: f64) -> Look {
        let mut look = Look { half_s, broken: None, unsettled: false };
        let mut posed: Vec<PosedLinks> = Vec::with_capacity(self.arms.len());
        for (arm, placed) in self.cell.indexed() {
            let swept = &self.arms[arm.0];
            let posture =
                ForwardKinematics::new(placed.model, &swept.joints(|cubic| cubic.angle(at_s)));
            let rates = swept.joints(|cubic| cubic.rate(at_s));
            self.look_at_tool(&mut look, arm, &posture, &rates);
            let links = PosedLinks::of(placed, &posture);
            self.look_at_table(&mut look, arm, &links);
            self.look_at_itself(&mut look, arm, &links);
            for (other, other_links) in posed.iter().enumerate() {
                self.look_between(&mut look, [ArmIndex(other), arm], [other_links, &links]);
            }
            posed.push(links);
        }
        look
    }

    fn look_at_tool(
        &self,
        look: &mut Look,
        arm: ArmIndex,
        posture: &ForwardKinematics,
        rates: &Joints,
    ) {
        let (settings, model) = (self.settings, self.cell.arms[arm.0].model);
        let change = &self.arms[arm.0].change;
        let speed_mps = posture.tool_velocity(rates).length();
        let allowed = settings.limits.tool_speed_mps;
        look.at_most(arm, speed_mps, allowed, (change.tool_speed, SPEED_TOLERANCE_MPS), |excess| {
            Reason::ToolSpeed(excess)
        });
        let distance_m = (posture.tool().origin_m - model.shoulder_m()).length();
        let allowed = settings.reach_share * model.reach_m();
        look.at_most(arm, distance_m, allowed, (change.reach, LENGTH_TOLERANCE_M), |excess| {
            Reason::Reach(excess)
        });
        let (tilt_rad, allowed) = (posture.tilt_rad(), settings.tilt_rad);
        look.at_most(arm, tilt_rad, allowed, (change.tilt, TILT_TOLERANCE_RAD), |excess| {
            Reason::Tilt(excess)
        });
    }

    fn look_at_table(&self, look: &mut Look, arm: ArmIndex, links: &PosedLinks) {
        let (gap_m, link) = links.table_gap_m(self.cell.table_z_m);
        let hides = (self.arms[arm.0].change.height, LENGTH_TOLERANCE_M);
        let name = self.cell.arms[arm.0].model.links[link].name;
        look.at_least(arm, gap_m, self.settings.table_gap_m, hides, |excess| {
            Reason::TableGap(name, excess)
        });
    }

    /// The arm's own parts. Joint 1 turns all of them together, so that what changes their distances is what changes heights.
    fn look_at_itself(&self, look: &mut Look, arm: ArmIndex, links: &PosedLinks) {
        let (model, swept) = (self.cell.arms[arm.0].model, &self.arms[arm.0]);
        let (gap_m, nearest) = links.self_gap_m(model, swept.gripper_opening);
        let hides = (swept.change.height, LENGTH_TOLERANCE_M);
        let names = nearest.map(|link| model.links[link].name);
        look.at_least(arm, gap_m, self.settings.self_gap_m, hides, |excess| {
            Reason::SelfGap(names, excess)
        });
    }

    fn look_between(&self, look: &mut Look, arms: [ArmIndex; 2], links: [&PosedLinks; 2]) {
        let (gap_m, nearest) = links[0].gap_m(links[1]);
        let change = arms.map(|arm| self.arms[arm.0].change.place);
        let hides = (change[0] + change[1], LENGTH_TOLERANCE_M);
        let names: [&'static str; 2] = std::array::from_fn(|side| {
            self.cell.arms[arms[side].0].model.links[nearest[side]].name
        });
        look.at_least(arms[0], gap_m, self.settings.arms_gap_m, hides, |excess| {
            Reason::ArmsGap(arms[1], names, excess)
        });
    }
}

impl Look {
    /// Notes a quantity that may be `allowed` at most. `hides` is its largest change per second and the tolerance.
    fn at_most(
        &mut self,
        arm: ArmIndex,
        got: f64,
        allowed: f64,
        hides: (f64, f64),
        reason: impl FnOnce(Excess) -> Reason,
    ) {
        self.note(arm, allowed - got, hides, || reason(Excess { got, allowed }));
    }

    /// Notes a quantity that has to be `allowed` at least.
    fn at_least(
        &mut self,
        arm: ArmIndex,
        got: f64,
        allowed: f64,
        hides: (f64, f64),
        reason: impl FnOnce(Excess) -> Reason,
    ) {
        self.note(arm, got - allowed, hides, || reason(Excess { got, allowed }));
    }

    /// A margin that is large enough for the whole interval is fine. Else it is settled as broken once no more than
    /// the tolerance can hide: the margin is then negative.
    fn note(
        &mut self,
        arm: ArmIndex,
        margin: f64,
        (per_s, tolerance): (f64, f64),
        reason: impl FnOnce() -> Reason,
    ) {
        let hidden = per_s * self.half_s;
        if margin >= hidden - tolerance {
            return;
        }
        self.unsettled |= hidden > tolerance;
        if margin < 0.0 && self.broken.is_none() {
            self.broken = Some((arm, reason()));
        }
    }
}

impl Swept {
    fn joints(&self, number: impl Fn(&Cubic) -> f64) -> Joints {
        Joints::from_fn(self.cubics.len(), |joint| number(&self.cubics[joint]))
    }

    fn changes(&self) -> Change {
        let rates = self.joints(Cubic::rate_bound);
        let accelerations = self.joints(Cubic::largest_acceleration);
        let last = rates.len() - 1;
        let mut change = Change::default();
        for (joint, rate) in rates.iter().enumerate() {
            let (tool_m, link_m) = (self.tool_levers_m[joint], self.link_levers_m[joint]);
            change.place += link_m * rate;
            // Joint 1 is upright and turns nothing up or down; the shoulder lies on its axis and on that of joint 2.
            change.height += if joint > 0 { link_m * rate } else { 0.0 };
            change.reach += if joint > 1 { tool_m * rate } else { 0.0 };
            // The last joint turns about the way the gripper points.
            change.tilt += if joint > 0 && joint < last { *rate } else { 0.0 };
            change.tool_speed += tool_m * accelerations[joint];
            for (other, other_rate) in rates.iter().enumerate() {
                change.tool_speed += self.tool_levers_m[joint.max(other)] * rate * other_rate;
            }
        }
        change
    }
}
