//! The simulated drives: commands take effect with a delay, joints follow with a lag, and brake by themselves if no
//! command arrives.

use std::collections::VecDeque;

use rand_chacha::ChaCha8Rng;
use tandem_core::rng::index;
use tandem_core::{ArmIndex, Contacts};
use tandem_kinematics::{ArmModel, Gaps, Joints, WorkCell};

use crate::simulated::config::{Disturbance, N_SUBSTEPS, PERIOD_S, SimulatedConfig};
use tandem_bridge::driver::{ArmCommand, Command, Order, SILENCE_S};

/// The duration of a physics step, seconds.
pub(crate) const SUBSTEP_S: f64 = PERIOD_S / N_SUBSTEPS as f64;

/// The drives of all arms and the true state of the joints.
pub(crate) struct Drives {
    /// Arm by arm.
    pub(crate) arms: Vec<ArmDrives>,
    gaps: Gaps,
    /// The contacts of the arms in the last physics step.
    contacts: Contacts,
    /// Whether parts of each arm touched each other in the last physics step.
    self_contacts: Vec<bool>,
    pending: VecDeque<PendingCommand>,
    order: Order,
    newest: u64,
    n_periods: u64,
    n_silent: u32,
    /// Whether the drives have braked by themselves and wait for an order to stop.
    tripped: bool,
    rng: ChaCha8Rng,
}

/// The drives of one arm.
#[derive(Debug, Clone)]
pub(crate) struct ArmDrives {
    model: &'static ArmModel,
    /// Radians.
    pub(crate) angles: Joints,
    /// Radians per second.
    pub(crate) velocities: Joints,
    /// The torque that stalls a joint, newton metres; 0 for joints that turn freely.
    pub(crate) stalled_nm: Joints,
    /// The commanded opening of the gripper.
    pub(crate) opening: f64,
}

/// A command that has not taken effect yet.
struct PendingCommand {
    due_period: u64,
    number: Option<u64>,
    order: Order,
}

impl Drives {
    pub(crate) fn new(cell: &WorkCell, at: &[Joints], opening: f64, rng: ChaCha8Rng) -> Self {
        let arm = |(placed, at): (&tandem_kinematics::PlacedArm, &Joints)| {
            let zero = Joints::from_fn(at.len(), |_| 0.0);
            let model = placed.model;
            ArmDrives { model, angles: *at, velocities: zero, stalled_nm: zero, opening }
        };
        Self {
            arms: cell.arms.iter().zip(at).map(arm).collect(),
            gaps: cell.gaps_with(at, &vec![opening; at.len()]),
            contacts: Contacts::NONE,
            self_contacts: vec![false; at.len()],
            pending: VecDeque::new(),
            order: Order::Stop,
            newest: 0,
            n_periods: 0,
            n_silent: 0,
            tripped: false,
            rng,
        }
    }

    /// The number of the newest command that has taken effect.
    pub(crate) fn newest(&self) -> u64 {
        self.newest
    }

    /// The number of periods that have passed.
    pub(crate) fn n_periods(&self) -> u64 {
        self.n_periods
    }

    /// Returns whether the drives have braked by themselves.
    pub(crate) fn tripped(&self) -> bool {
        self.tripped
    }

    /// The present gaps around the arms.
    pub(crate) fn gaps(&self) -> &Gaps {
        &self.gaps
    }

    /// The contacts of the arms in the last physics step.
    pub(crate) fn contacts(&self) -> Contacts {
        self.contacts
    }

    /// Whether parts of each arm touched each other in the last physics step.
    pub(crate) fn self_contacts(&self) -> &[bool] {
        &self.self_contacts
    }

    /// Accepts a command, which takes effect after the latency.
    pub(crate) fn send(&mut self, command: Command, latency_periods: [u32; 2]) {
        self.n_silent = 0;
        self.enqueue(Some(command.number), command.order, latency_periods);
    }

    /// Accepts an order to stop outside of an exchange, with the same latency.
    pub(crate) fn stop(&mut self, latency_periods: [u32; 2]) {
        self.enqueue(None, Order::Stop, latency_periods);
    }

    fn enqueue(&mut self, number: Option<u64>, order: Order, [least, most]: [u32; 2]) {
        let extra = index(&mut self.rng, (most.max(least) - least) as usize + 1);
        let due_period = self.n_periods + u64::from(least) + extra as u64;
        let due_period = self.pending.back().map_or(0, |last| last.due_period).max(due_period);
        self.pending.push_back(PendingCommand { due_period, number, order });
    }

    /// Starts the next period: due commands take effect, and the drives brake after too long a silence.
    pub(crate) fn begin_period(&mut self) {
        while self.pending.front().is_some_and(|next| next.due_period <= self.n_periods) {
            let Some(next) = self.pending.pop_front() else { break };
            self.newest = next.number.unwrap_or(self.newest);
            if next.order == Order::Stop {
                self.tripped = false;
            }
            self.order = next.order;
        }
        self.tripped |= f64::from(self.n_silent) * PERIOD_S >= SILENCE_S - 0.5 * PERIOD_S;
        self.n_silent += 1;
        self.n_periods += 1;
        if let (Order::Move(commands), false) = (&self.order, self.tripped) {
            for (arm, command) in self.arms.iter_mut().zip(commands) {
                arm.opening = command.opening.clamp(0.0, 1.0);
            }
        }
    }

    /// Simulates a physics step with the grippers at `openings` (0 to 1) and external torques `torques_nm`.
    pub(crate) fn step(
        &mut self,
        cell: &WorkCell,
        config: &SimulatedConfig,
        disturbance: &Disturbance,
        openings: &[f64],
        torques_nm: &[Joints],
    ) {
        let before: Vec<Joints> = self.arms.iter().map(|arm| arm.angles).collect();
        let commands = match (&self.order, self.tripped) {
            (Order::Move(commands), false) => Some(commands),
            _ => None,
        };
        for (idx, arm) in self.arms.iter_mut().enumerate() {
            let drift = disturbance.drift_radps.get(idx);
            let faults = disturbance.faults.get(idx).copied().unwrap_or_default();
            let has_power = !(faults.drive || faults.emergency_stop);
            let commands = commands.filter(|_| has_power);
            let target = commands.map(|commands| servo_target(&commands[idx], drift));
            let is_blocked = |joint| disturbance.blocked.contains(&(ArmIndex(idx), joint));
            arm.follow(target.as_ref(), config, is_blocked, &torques_nm[idx]);
        }
        self.keep_apart(cell, config, openings, &before);
    }

    /// Holds arms in place that would penetrate each other, the table or themselves more deeply.
    fn keep_apart(
        &mut self,
        cell: &WorkCell,
        config: &SimulatedConfig,
        openings: &[f64],
        before: &[Joints],
    ) {
        let angles: Vec<Joints> = self.arms.iter().map(|arm| arm.angles).collect();
        let gaps = cell.gaps_with(&angles, openings);
        self.self_contacts = gaps.self_m.iter().map(|gap_m| *gap_m <= 0.0).collect();
        let deeper = |now: f64, then: f64| now < 0.0 && now < then;
        let pressed = deeper(gaps.arms_m, self.gaps.arms_m);
        self.contacts = if gaps.arms_m <= 0.0 { Contacts::ARM_ARM } else { Contacts::NONE };
        let mut any = false;
        for (idx, arm) in self.arms.iter_mut().enumerate() {
            if gaps.table_m[idx] <= 0.0 {
                self.contacts = self.contacts | Contacts::ARM_TABLE;
            }
            let by_itself = deeper(gaps.table_m[idx], self.gaps.table_m[idx])
                || deeper(gaps.self_m[idx], self.gaps.self_m[idx]);
            if pressed || by_itself {
                arm.hold_at(&before[idx], config);
                any = true;
            }
        }
        let angles: Vec<Joints> = self.arms.iter().map(|arm| arm.angles).collect();
        self.gaps = if any { cell.gaps_with(&angles, openings) } else { gaps };
    }
}

impl ArmDrives {
    /// Moves the joints for one physics step towards the `target` velocities, or brakes if there are none.
    fn follow(
        &mut self,
        target: Option<&Joints>,
        config: &SimulatedConfig,
        is_blocked: impl Fn(usize) -> bool,
        torques_nm: &Joints,
    ) {
        for (idx, joint) in self.model.joints.iter().enumerate() {
            let speed = self.velocities[idx];
            let next = match target {
                Some(target) => {
                    let share = SUBSTEP_S / (config.lag_s + SUBSTEP_S);
                    let most = config.motor_radps2 * SUBSTEP_S;
                    speed + (share * (target[idx] - speed)).clamp(-most, most)
                }
                None => {
                    let most = joint.speed_radps / config.brake_s * SUBSTEP_S;
                    speed - speed.clamp(-most, most)
                }
            };
            let stalled =
                next * torques_nm[idx] < 0.0 && torques_nm[idx].abs() > config.stall_nm[idx];
            let [low, high] = joint.range_rad;
            let angle = self.angles[idx] + next * SUBSTEP_S;
            let at_end = !(low..=high).contains(&angle);
            if is_blocked(idx) || stalled || at_end {
                let pushes = target.map_or(0.0, |target| target[idx]);
                self.stalled_nm[idx] =
                    -pushes.signum() * f64::from(pushes != 0.0) * config.stall_nm[idx];
                self.velocities[idx] = 0.0;
            } else {
                self.stalled_nm[idx] = 0.0;
                self.velocities[idx] = next;
                self.angles[idx] = angle;
            }
        }
    }

    /// Holds the joints at `angles`, where an obstacle blocks them.
    fn hold_at(&mut self, angles: &Joints, config: &SimulatedConfig) {
        self.angles = *angles;
        for joint in 0..angles.len() {
            self.stalled_nm[joint] = -self.velocities[joint].signum() * config.stall_nm[joint];
            self.velocities[joint] = 0.0;
        }
    }
}

/// Returns the velocities that the servos try to keep.
fn servo_target(command: &ArmCommand, drift: Option<&Joints>) -> Joints {
    Joints::from_fn(command.velocities.len(), |joint| {
        command.velocities[joint] + drift.map_or(0.0, |drift| drift[joint])
    })
}
