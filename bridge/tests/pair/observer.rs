//! An observer of the true arms, period by period, independent of the executor.

use tandem_bridge::work_cell::mico_cell;
use tandem_core::ArmIndex;
use tandem_kinematics::{ForwardKinematics, Joints, WorkCell};
use tandem_trials::SimulatedPair;
use tandem_trials::simulated::PERIOD_S;

/// Tool speed, metres per second; gaps, metres: as the executor's settings have them.
const TOOL_MPS: f64 = 0.20;
const TABLE_GAP_M: f64 = 0.001;
const ARMS_GAP_M: f64 = 0.012;
const SELF_GAP_M: f64 = 0.002;
const RAMP_S: f64 = 0.25;
/// Time in which the simulated drives brake, seconds.
const BRAKE_S: f64 = 0.040;

/// The allowed excess of the limits.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Slack {
    /// The part of a joint's speed that the fault itself causes, radians per second.
    pub(crate) drift_radps: f64,
    /// The executor knows angles with a noise of 0.015 degrees, three times of which are 0.5 mm at a lever of 0.57 m. A
    /// drift that begins is known and braked some 50 ms later: 12 degrees/s make 3 mm at 0.3 m. The rest of the
    /// gaps is there for this.
    pub(crate) gap_m: f64,
    /// True if a fault makes joints start or stop at once.
    pub(crate) sudden: bool,
}

impl Slack {
    pub(crate) const NONE: Self = Self { drift_radps: 0.0, gap_m: 0.0005, sudden: false };
}

pub(crate) struct Observer {
    cell: WorkCell,
    slack: Slack,
    before: Option<Vec<Joints>>,
    /// The simulated time at which a joint last moved, seconds.
    pub(crate) moved_s: f64,
    /// Largest shares of limits.
    pub(crate) tool_share: f64,
    pub(crate) least_arms_gap_m: f64,
    pub(crate) least_table_gap_m: f64,
}

impl Observer {
    pub(crate) fn new(slack: Slack) -> Self {
        Self {
            cell: mico_cell(),
            slack,
            before: None,
            moved_s: 0.0,
            tool_share: 0.0,
            least_arms_gap_m: f64::INFINITY,
            least_table_gap_m: f64::INFINITY,
        }
    }

    /// Asserts that no limit is exceeded; `what` appears in messages.
    pub(crate) fn look(&mut self, pair: &SimulatedPair, what: &str) {
        let [angles, rates]: [Vec<Joints>; 2] = [
            [0, 1].map(|arm| *pair.angles(ArmIndex(arm))).to_vec(),
            [0, 1].map(|arm| *pair.velocities(ArmIndex(arm))).to_vec(),
        ];
        let time_s = pair.time_s();
        for arm in 0..2 {
            self.look_at_joints(arm, &angles[arm], &rates[arm], &format!("{what}, {time_s:.2} s"));
        }
        if rates.iter().flat_map(|rates| rates.iter()).any(|rate| *rate != 0.0) {
            self.moved_s = time_s;
        }
        let gaps = self.cell.gaps(&angles);
        for gap_m in &gaps.table_m {
            self.least_table_gap_m = self.least_table_gap_m.min(*gap_m);
            assert!(*gap_m >= TABLE_GAP_M - self.slack.gap_m, "{what}, {time_s:.2} s: {gaps:?}");
        }
        for gap_m in &pair.gaps().self_m {
            assert!(*gap_m >= SELF_GAP_M - self.slack.gap_m, "{what}, {time_s:.2} s: {gaps:?}");
        }
        self.least_arms_gap_m = self.least_arms_gap_m.min(gaps.arms_m);
        let allowed_m = ARMS_GAP_M - 2.0 * self.slack.gap_m;
        assert!(gaps.arms_m >= allowed_m, "{what}, {time_s:.2} s: {gaps:?}");
        // The shapes are a centimetre larger than the arms. A drift may use up a part of that, the slack.
        let may_graze = self.slack.gap_m > TABLE_GAP_M;
        assert!(may_graze || !pair.contacts().any(), "{what}, {time_s:.2} s: contact");
        let touches_itself = (0..2).any(|arm| pair.touches_itself(ArmIndex(arm)));
        assert!(!touches_itself, "{what}, {time_s:.2} s: an arm touches itself");
        self.before = Some(rates);
    }

    fn look_at_joints(&mut self, arm: usize, angles: &Joints, rates: &Joints, what: &str) {
        let placed = &self.cell.arms[arm];
        for (idx, joint) in placed.model.joints.iter().enumerate() {
            let [low, high] = joint.range_rad;
            assert!((low..=high).contains(&angles[idx]), "{what}: joint {idx} at {angles:?}");
            let allowed = joint.speed_radps * (1.0 + 1e-9) + self.slack.drift_radps;
            assert!(rates[idx].abs() <= allowed, "{what}: joint {idx} at {rates:?}");
            if let Some(before) = &self.before {
                let (rate, before) = (rates[idx], before[arm][idx]);
                let got = (rate - before).abs() / PERIOD_S;
                // Two commands may take effect in one period.
                let hardest = if rate.abs() > before.abs() { 2.0 / RAMP_S } else { 1.0 / BRAKE_S };
                let allowed = joint.speed_radps * hardest * (1.0 + 1e-6);
                assert!(
                    self.slack.sudden || got <= allowed,
                    "{what}: joint {idx} {before} to {rate}"
                );
            }
        }
        let posture = ForwardKinematics::new(placed.model, angles);
        let tool_mps = posture.tool_velocity(rates).norm();
        let drift_mps = self.slack.drift_radps * 3.0 * 0.6;
        self.tool_share = self.tool_share.max(tool_mps / TOOL_MPS);
        // The executor computes tool velocities at a position that is some periods old.
        assert!(tool_mps <= 1.04 * TOOL_MPS + drift_mps, "{what}: tool at {tool_mps}");
    }
}
