//! The limits of every command, checked independently of its source.
//!
//! The envelope checks each command before it is sent, at the measured position of the arms. Speeds and accelerations
//! are those of the command itself. Ranges and gaps are checked along the **stopping path**: from the measured angles,
//! through the commands that have not taken effect yet and the new command, to the position where the arms come to rest
//! if they brake after it. If every command has a stopping path within the limits, the arms can stop within the limits
//! at any time, along the path of the previous command.
//!
//! The path is a sequence of joint configurations connected by straight lines in joint space. On a line that turns the
//! joints by `d`, no point of an arm moves farther than the sum of `d` times the joints' levers. If the gap in the
//! middle exceeds the limit by half of that, the limit holds on the whole line. Otherwise both halves are checked, down
//! to a tenth of a millimetre.
//!
//! For gaps between parts of one arm, the width of a gripper is the larger of its measured and its commanded opening.
//! The gripper is never wider between the two.

use tandem_kinematics::model::Joint;
use tandem_kinematics::{Excess, ForwardKinematics, Joints, PlacedArm, WorkCell};

use crate::driver::{ArmCommand, PairState};
use crate::executor::commands::VelocityHistory;
use crate::executor::settings::Settings;
use crate::executor::stop::{LocatedCause, StopCause};

/// Relative slack for rounding.
const ROUNDING: f64 = 1e-9;
/// Relative slack of the tool's speed limit: the speed is computed from angles that are a few periods old.
const TOOL_SPEED_SLACK: f64 = 0.02;
/// The deviation of a joint's speed from its commands that lag and noise explain, radians per second.
const EXPLAINED_RADPS: f64 = 2.5 * std::f64::consts::PI / 180.0;
/// Half the movement below which a line is not divided further, metres.
const RESOLUTION_M: f64 = 1e-4;
/// Number of configurations on the braking part of a stopping path.
const N_BRAKING: u32 = 4;

/// Returns the lowest and highest velocity that a joint may be commanded next, radians per second, if its last command
/// was `before`. It accelerates no harder than motions do and decelerates no harder than the drives brake.
pub(crate) fn reachable(
    joint: &Joint,
    before: f64,
    settings: &Settings,
    period_s: f64,
) -> [f64; 2] {
    let faster = joint.speed_radps / settings.check.limits.ramp_s * period_s;
    let slower = joint.speed_radps / settings.brake_s * period_s;
    let towards_zero = |speed: f64| {
        // Braking comes first; the rest of the period is available for accelerating in the other direction.
        if speed >= slower { slower } else { speed + faster * (1.0 - speed / slower) }
    };
    let [down, up] = if before >= 0.0 {
        [towards_zero(before), faster]
    } else {
        [faster, towards_zero(-before)]
    };
    [before - down, before + up]
}

/// The envelope of one work cell.
#[derive(Debug, Clone)]
pub(crate) struct Envelope {
    cell: WorkCell,
    settings: Settings,
    period_s: f64,
    /// For each arm and joint, an upper bound of the distance of the arm's points from the joint's axis, metres.
    levers_m: Vec<Joints>,
}

impl Envelope {
    pub(crate) fn new(cell: &WorkCell, settings: &Settings, period_s: f64) -> Self {
        let levers = |arm: &PlacedArm| arm.model.link_levers_m();
        Self {
            cell: cell.clone(),
            settings: *settings,
            period_s,
            levers_m: cell.arms.iter().map(levers).collect(),
        }
    }

    /// Checks that `commands` keep every limit. `state` is the newest state, `stale_s` its age beyond one period,
    /// seconds.
    pub(crate) fn check(
        &self,
        commands: &[ArmCommand],
        history: &VelocityHistory,
        state: &PairState,
        stale_s: f64,
    ) -> Result<(), LocatedCause> {
        for (arm, command) in commands.iter().enumerate() {
            self.check_numbers(arm, command, history.front().map(|velocities| &velocities[arm]))?;
            self.check_tool(arm, command, &state.arms[arm].angles)?;
        }
        let paths = self.stopping_paths(commands, history, state, stale_s);
        for (arm, path) in paths.iter().enumerate() {
            self.check_ranges(arm, path)?;
        }
        let openings: Vec<f64> = commands
            .iter()
            .zip(&state.arms)
            .map(|(command, arm)| command.opening.max(arm.opening).clamp(0.0, 1.0))
            .collect();
        let n_steps = paths[0].len();
        for step in 1..n_steps {
            let ends = [step - 1, step].map(|idx| paths.iter().map(|path| path[idx]).collect());
            self.check_gaps(&ends, &openings)?;
        }
        Ok(())
    }

    fn check_numbers(
        &self,
        arm: usize,
        command: &ArmCommand,
        before: Option<&Joints>,
    ) -> Result<(), LocatedCause> {
        let joints = self.cell.arms[arm].model.joints;
        if command.velocities.len() != joints.len()
            || !command.velocities.is_finite()
            || !(0.0..=1.0).contains(&command.opening)
        {
            return Err(StopCause::CommandNotFinite.of(arm));
        }
        for (idx, (joint, velocity)) in joints.iter().zip(command.velocities.iter()).enumerate() {
            let (got, allowed) = (velocity.abs(), joint.speed_radps);
            if got > allowed * (1.0 + ROUNDING) {
                return Err(StopCause::JointSpeed(Excess { got, allowed }).of_joint(arm, idx));
            }
            let before = before.map_or(0.0, |before| before[idx]);
            let [low, high] = reachable(joint, before, &self.settings, self.period_s);
            if *velocity < low - ROUNDING || *velocity > high + ROUNDING {
                let end = if *velocity < low { low } else { high };
                let [got, allowed] = [velocity, &end].map(|to| (to - before).abs() / self.period_s);
                let cause = StopCause::JointAcceleration(Excess { got, allowed });
                return Err(cause.of_joint(arm, idx));
            }
        }
        Ok(())
    }

    fn check_tool(
        &self,
        arm: usize,
        command: &ArmCommand,
        at: &Joints,
    ) -> Result<(), LocatedCause> {
        let posture = ForwardKinematics::new(self.cell.arms[arm].model, at);
        let got = posture.tool_velocity(&command.velocities).norm();
        let allowed = self.settings.check.limits.tool_speed_mps;
        if got > allowed * (1.0 + TOOL_SPEED_SLACK) {
            return Err(StopCause::ToolSpeed(Excess { got, allowed }).of(arm));
        }
        Ok(())
    }

    /// The stopping path of each arm, joint angles in radians. All paths have the same length.
    fn stopping_paths(
        &self,
        commands: &[ArmCommand],
        history: &VelocityHistory,
        state: &PairState,
        stale_s: f64,
    ) -> Vec<Vec<Joints>> {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a reaction takes a few periods"
        )]
        let n_pending =
            ((self.settings.reaction_s + stale_s.max(0.0)) / self.period_s - 1e-6).ceil() as usize;
        let path = |(arm, command): (usize, &ArmCommand)| {
            let (reading, model) = (&state.arms[arm], self.cell.arms[arm].model);
            let unexplained = unexplained(&reading.velocities, arm, history);
            let mut at = reading.angles;
            let mut path = vec![at];
            let pending = history
                .iter()
                .take(n_pending.saturating_sub(1))
                .rev()
                .map(|velocities| &velocities[arm]);
            for velocities in pending.chain([&command.velocities]) {
                at = Joints::from_fn(at.len(), |joint| {
                    at[joint] + (velocities[joint] + unexplained[joint]) * self.period_s
                });
                path.push(at);
            }
            for step in 1..=N_BRAKING {
                let since_s = self.settings.brake_s * f64::from(step) / f64::from(N_BRAKING);
                path.push(Joints::from_fn(at.len(), |joint| {
                    let speed = command.velocities[joint] + unexplained[joint];
                    let brake = model.joints[joint].speed_radps / self.settings.brake_s;
                    at[joint] + braking_angle(speed, brake, since_s)
                }));
            }
            path
        };
        commands.iter().enumerate().map(path).collect()
    }

    fn check_ranges(&self, arm: usize, path: &[Joints]) -> Result<(), LocatedCause> {
        for (idx, joint) in self.cell.arms[arm].model.joints.iter().enumerate() {
            let [low, high] = joint.range_rad;
            for angles in path {
                let got = angles[idx];
                if !(low..=high).contains(&got) {
                    let allowed = if got > high { high } else { low };
                    return Err(StopCause::JointRange(Excess { got, allowed }).of_joint(arm, idx));
                }
            }
        }
        Ok(())
    }

    /// Checks the gaps on the straight line in joint space between two configurations of all arms.
    fn check_gaps(
        &self,
        [from, to]: &[Vec<Joints>; 2],
        openings: &[f64],
    ) -> Result<(), LocatedCause> {
        let moved_m = |arm: usize| -> f64 {
            let levers = self.levers_m[arm].iter().zip(from[arm].iter().zip(to[arm].iter()));
            levers.map(|(lever_m, (a, b))| lever_m * (b - a).abs()).sum()
        };
        let half_m: Vec<f64> = (0..from.len()).map(|arm| 0.5 * moved_m(arm)).collect();
        let middle: Vec<Joints> = from
            .iter()
            .zip(to)
            .map(|(a, b)| Joints::from_fn(a.len(), |joint| 0.5 * (a[joint] + b[joint])))
            .collect();
        let gaps = self.cell.gaps_with(&middle, openings);
        let mut settled = true;
        for (arm, half_m) in half_m.iter().enumerate() {
            let mut keeps = |got: f64, allowed: f64| {
                settled &= got - half_m >= allowed || *half_m <= RESOLUTION_M;
                if got < allowed { Err(Excess { got, allowed }) } else { Ok(()) }
            };
            keeps(gaps.table_m[arm], self.settings.table_gap_m)
                .map_err(|excess| StopCause::TableGap(excess).of(arm))?;
            keeps(gaps.self_m[arm], self.settings.self_gap_m)
                .map_err(|excess| StopCause::SelfGap(excess).of(arm))?;
        }
        let (got, allowed) = (gaps.arms_m, self.settings.arms_gap_m);
        let both_m: f64 = half_m.iter().sum();
        settled &= got - both_m >= allowed || both_m <= RESOLUTION_M;
        if got < allowed {
            return Err(StopCause::ArmsGap(Excess { got, allowed }).anywhere());
        }
        if settled {
            return Ok(());
        }
        self.check_gaps(&[from.clone(), middle.clone()], openings)?;
        self.check_gaps(&[middle, to.clone()], openings)
    }
}

/// The part of the measured joint velocities that no recent command explains, radians per second.
fn unexplained(measured: &Joints, arm: usize, history: &VelocityHistory) -> Joints {
    Joints::from_fn(measured.len(), |joint| {
        let sent = || history.iter().map(|sent| sent[arm][joint]);
        let low = sent().fold(0.0, f64::min) - EXPLAINED_RADPS;
        let high = sent().fold(0.0, f64::max) + EXPLAINED_RADPS;
        measured[joint] - measured[joint].clamp(low, high)
    })
}

/// The angle by which a joint turns within `since_s` if it brakes from `speed`, radians.
fn braking_angle(speed: f64, brake: f64, since_s: f64) -> f64 {
    let since_s = since_s.min(speed.abs() / brake);
    (speed.abs() - 0.5 * brake * since_s) * since_s * speed.signum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driver::{ArmReading, Faults};
    use crate::work_cell::mico_cell;
    use tandem_kinematics::MICO_4;

    const PERIOD_S: f64 = 0.01;
    const DEGREE: f64 = std::f64::consts::PI / 180.0;

    /// Both arms at rest at `at`.
    fn state(at: &[Joints]) -> PairState {
        let zero = Joints::new(&[0.0; 4]);
        let reading = |angles: &Joints| ArmReading {
            angles: *angles,
            velocities: zero,
            torques_nm: None,
            opening: 0.0,
            faults: Faults::default(),
        };
        let arms = at.iter().map(reading).collect();
        PairState { sequence: 1, stamp_s: 0.0, newest_command: None, arms }
    }

    /// Checks velocities in degrees per second that were also the last commands.
    fn check(at: &[Joints], degrees: [[f64; 4]; 2]) -> Result<(), LocatedCause> {
        let velocities = degrees.map(|arm| Joints::new(&arm.map(|rate| rate * DEGREE)));
        let history: VelocityHistory = (0..8).map(|_| velocities.to_vec()).collect();
        check_after(at, velocities, &history)
    }

    fn check_after(
        at: &[Joints],
        velocities: [Joints; 2],
        history: &VelocityHistory,
    ) -> Result<(), LocatedCause> {
        let envelope = Envelope::new(&mico_cell(), &Settings::default(), PERIOD_S);
        let commands = velocities.map(|velocities| ArmCommand { velocities, opening: 0.5 });
        envelope.check(&commands, history, &state(at), 0.0)
    }

    fn ready() -> Vec<Joints> {
        mico_cell().ready(0.06).unwrap()
    }

    const REST: [f64; 4] = [0.0; 4];

    #[test]
    fn commands_within_all_limits_pass() {
        assert_eq!(check(&ready(), [REST, REST]), Ok(()));
        assert_eq!(check(&ready(), [[10.0, 5.0, -5.0, 40.0], REST]), Ok(()));
    }

    #[test]
    fn a_joint_stops_before_the_end_of_its_range() {
        // At 20 degrees/s: 0.2 degrees in each of four periods, and 20² / (2 · 720) while it brakes.
        let way_deg = 4.0 * 0.2 + 20.0 * 20.0 / (2.0 * 36.0 / 0.05);
        let [low, high] = MICO_4.joints[2].range_rad;
        for (end, rate) in [(low, -20.0), (high, 20.0)] {
            let mut at = ready();
            let towards = rate * DEGREE / 20.0;
            at[1][2] = end - (way_deg + 0.01) * towards;
            let gaps = check(&at, [REST, [0.0, 0.0, rate, 0.0]]);
            let is_range =
                |located: &LocatedCause| matches!(located.cause, StopCause::JointRange(_));
            assert!(!gaps.as_ref().is_err_and(is_range), "{gaps:?}");
            at[1][2] = end - (way_deg - 0.01) * towards;
            let located = check(&at, [REST, [0.0, 0.0, rate, 0.0]]).unwrap_err();
            assert!(is_range(&located) && located.joint == Some(2), "{located:?}");
        }
    }

    #[test]
    fn an_arm_stops_before_the_table() {
        let cell = mico_cell();
        let (mut passed, mut refused) = (0, 0);
        for step in 0..40 {
            let at = cell.ready(0.001 + 0.0005 * f64::from(step)).unwrap();
            // Joint 2 leans the arm down, at about 0.1 m/s.
            match check(&at, [REST, [0.0, -20.0, 0.0, 0.0]]) {
                Ok(()) => {
                    passed += 1;
                    // What passes has room for four periods and the braking: 0.02 m/s would not need it.
                    assert!(cell.gaps(&at).table_m[1] > 0.004);
                }
                Err(located) => {
                    assert!(matches!(located.cause, StopCause::TableGap(_)), "{located:?}");
                    assert_eq!(located.arm.map(|arm| arm.0), Some(1));
                    refused += 1;
                }
            }
            assert_eq!(check(&at, [REST, REST]), Ok(()));
        }
        assert!(passed > 3 && refused > 3, "{passed} {refused}");
    }

    #[test]
    fn arms_stop_before_they_touch() {
        let mut cell = mico_cell();
        let at = ready();
        // The second base is moved up until the elbows are nearly as near as they may be.
        for _ in 0..100 {
            let gap_m = cell.gaps(&at).arms_m;
            cell.arms[1].base_in_world_m.x -= gap_m - 0.013;
        }
        assert!((cell.gaps(&at).arms_m - 0.013).abs() < 1e-4);
        let envelope = Envelope::new(&cell, &Settings::default(), PERIOD_S);
        let check = |rate: f64| {
            let lean = Joints::new(&[0.0, rate * DEGREE, 0.0, 0.0]);
            let history: VelocityHistory = (0..8).map(|_| vec![lean; 2]).collect();
            let commands = [ArmCommand { velocities: lean, opening: 0.0 }; 2];
            envelope.check(&commands, &history, &state(&at), 0.0)
        };
        assert_eq!(check(0.0), Ok(()));
        let [one, other] = [check(20.0), check(-20.0)];
        let near = |result: &Result<(), LocatedCause>| {
            result.as_ref().is_err_and(|located| matches!(located.cause, StopCause::ArmsGap(_)))
        };
        assert!(near(&one) != near(&other), "towards each other only: {one:?} {other:?}");
    }

    /// The posture on the way of arm 0 from the ready one into its own base in which the gap there is `gap_m`, with the
    /// gripper half open, and the arm's velocities on this way, in degrees per second.
    fn near_own_base(gap_m: f64) -> (Vec<Joints>, [f64; 4]) {
        let (cell, at) = (mico_cell(), ready());
        let way_deg = [0.0, -11.3, 27.0, 90.3];
        let on_way = |share: f64| {
            let mut on_way = at.clone();
            on_way[0] = Joints::from_fn(4, |joint| at[0][joint] + share * way_deg[joint] * DEGREE);
            on_way
        };
        let [mut near, mut far] = [1.0, 0.0];
        for _ in 0..40 {
            let middle = 0.5 * (near + far);
            let is_near = cell.gaps_with(&on_way(middle), &[0.5; 2]).self_m[0] < gap_m;
            *(if is_near { &mut near } else { &mut far }) = middle;
        }
        (on_way(far), way_deg.map(|way| 0.4 * way))
    }

    #[test]
    fn an_arm_stops_before_it_touches_itself() {
        let (at, towards) = near_own_base(0.003);
        assert_eq!(check(&at, [REST, REST]), Ok(()));
        assert_eq!(check(&at, [towards.map(|rate| -rate), REST]), Ok(()));
        let located = check(&at, [towards, REST]).unwrap_err();
        assert!(matches!(located.cause, StopCause::SelfGap(_)), "{located:?}");
        assert_eq!(located.arm.map(|arm| arm.0), Some(0));
        // With room for four periods and the braking it may continue.
        let (at, towards) = near_own_base(0.008);
        assert_eq!(check(&at, [towards, REST]), Ok(()));
    }

    #[test]
    fn self_gaps_use_the_measured_width_of_a_gripper_that_is_wider_than_commanded() {
        let (at, _) = near_own_base(0.003);
        let envelope = Envelope::new(&mico_cell(), &Settings::default(), PERIOD_S);
        let command = ArmCommand { velocities: Joints::new(&REST), opening: 0.5 };
        let check = |opening: f64| {
            let mut state = state(&at);
            state.arms[0].opening = opening;
            envelope.check(&[command; 2], &VelocityHistory::new(), &state, 0.0)
        };
        assert_eq!(check(0.4), Ok(()));
        let located = check(0.9).unwrap_err();
        assert!(matches!(located.cause, StopCause::SelfGap(_)), "{located:?}");
    }

    #[test]
    fn commands_are_numbers_within_speed_and_acceleration() {
        let at = ready();
        let zero = Joints::new(&REST);
        let still: VelocityHistory = (0..8).map(|_| vec![zero; 2]).collect();
        let from_rest = |rate: f64| {
            let velocities = Joints::new(&[0.0, 0.0, 0.0, rate * DEGREE]);
            check_after(&at, [velocities, zero], &still).map_err(|located| located.cause)
        };
        // 48 degrees/s in 0.25 s are 1.92 degrees/s a period.
        assert_eq!(from_rest(1.91), Ok(()));
        assert!(matches!(from_rest(1.93), Err(StopCause::JointAcceleration(_))));
        assert!(matches!(from_rest(f64::NAN), Err(StopCause::CommandNotFinite)));
        let located = check(&at, [REST, [0.0, 0.0, 0.0, 48.1]]).unwrap_err();
        assert!(matches!(located.cause, StopCause::JointSpeed(_)) && located.joint == Some(3));
        // Joints 1 to 3 of an outstretched arm at full speed are too fast for the tool.
        let mut far = at.clone();
        far[0][1] = 120.0 * DEGREE;
        far[0][2] = 200.0 * DEGREE;
        let located = check(&far, [[36.0, 0.0, 0.0, 0.0], REST]).unwrap_err();
        assert!(matches!(located.cause, StopCause::ToolSpeed(_)), "{located:?}");
    }

    #[test]
    fn slowing_down_may_be_harder_than_speeding_up() {
        let joint = &MICO_4.joints[0];
        let check = |before: f64, expected: [f64; 2]| {
            let got = reachable(joint, before * DEGREE, &Settings::default(), PERIOD_S);
            for (got, expected) in got.iter().zip(expected) {
                assert!((got / DEGREE - expected).abs() < 1e-9, "{before}: {got} {expected}");
            }
        };
        // 36 degrees/s in 0.25 s and in 0.05 s: 1.44 and 7.2 degrees/s a period.
        check(0.0, [-1.44, 1.44]);
        check(20.0, [12.8, 21.44]);
        check(-20.0, [-21.44, -12.8]);
        check(3.6, [-0.72, 5.04]);
    }

    #[test]
    fn drifts_lengthen_the_stopping_way() {
        let history: VelocityHistory = (0..8).map(|_| vec![Joints::new(&REST); 2]).collect();
        let measured = Joints::new(&[2.0 * DEGREE, -10.0 * DEGREE, 0.0, 3.0 * DEGREE]);
        let drift = unexplained(&measured, 0, &history);
        for (got, expected) in drift.iter().zip([0.0, -7.5, 0.0, 0.5]) {
            assert!((got / DEGREE - expected).abs() < 1e-9, "{drift:?}");
        }
    }
}
