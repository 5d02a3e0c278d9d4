//! Episodes of a trial in the closed loop.
//!
//! A policy that has not succeeded by the end of its episode plays another one, from a start like those that it was
//! trained with. Its actions then have noise: a policy without noise would fail in the same way again. Arms take turns
//! if their objects could meet ([`super::order`]) or if they block each other. Arms that share an object play one
//! episode; if they cannot carry out its steps, the actions of the remaining steps have noise.

use glam::DVec3;
use tandem_core::{ArmIndex, Stream, episode_rng};

use super::{ClosedLoop, DONE_SHARE, LoopState, WantedStep};
use crate::simulated::ObjectPose;
use crate::trial::noise::add_noise;
use crate::trial::outcome::FailureCause;
use crate::trial::rehearsal::TrialStart;
use crate::trial::runner::{REST_S, TrialExecution, TrialRunner};

/// A policy is done after this many consecutive observations of placed objects that stay there.
const DONE_OBSERVATIONS: usize = 5;
/// Arms are blocked when the steps that they did not carry out in full outnumber the others by this many.
const MAX_BLOCKED: usize = 10;
/// Height above the table, metres, below which an object lies on it.
const LYING_HEIGHT_M: f64 = 0.01;
/// Height by which a hand rises before it withdraws, metres.
const RISE_M: f64 = 0.06;

/// What follows a step when arms block each other or an arm waits.
#[derive(Debug, PartialEq)]
enum NextAction {
    /// All arms continue as before.
    Same,
    /// These arms retreat and keep out of the way; the others continue.
    Parks(Vec<bool>),
    /// All arms begin another episode.
    NextEpisode,
}

impl ClosedLoop<'_, '_> {
    /// Runs the closed loop until the objects are placed, the time is over or a step fails. Arms that share an object
    /// have one episode.
    pub(in crate::trial) fn run(mut self) -> TrialExecution {
        let ended = self.episodes();
        self.state.count_success(self.runner.is_success(self.rig, self.start));
        TrialExecution {
            ended,
            n_steps: self.n_steps,
            n_shortened: self.n_shortened,
            rehearsed_m: None,
            timed_out: self.timed_out,
            n_in_success: self.state.n_in_success,
            waypoints: self.state.waypoints,
        }
    }

    fn episodes(&mut self) -> Result<(), FailureCause> {
        let (runner, start) = (self.runner, self.start);
        let shares_object = runner.task.shares_object();
        let time_limit_s = runner.config.time_limit_s / runner.config.speed;
        let (mut n_in_episode, mut n_blocked) = (0, 0_usize);
        self.order_arms()?;
        loop {
            if self.state.n_done == DONE_OBSERVATIONS {
                if self.stay_placed()? {
                    return Ok(());
                }
                self.state.n_done = 0;
            }
            self.timed_out = self.rig.now_s() > time_limit_s;
            let is_over = n_in_episode == runner.task.episode_steps();
            if self.timed_out || is_over && shares_object {
                return self.rig.wait(REST_S);
            }
            if is_over {
                self.start_next_episode()?;
                n_in_episode = 0;
            }
            self.n_steps += 1;
            // Steps in which an arm waited or went only part of its way do not count: the policy's episode has none.
            if self.step()? {
                n_in_episode += 1;
                n_blocked = n_blocked.saturating_sub(1);
            } else {
                self.n_shortened += 1;
                n_blocked += 1;
                // Noise may not help either, and arms that share an object have no other episode.
                n_in_episode += usize::from(shares_object && self.state.noise.is_some());
            }
            if shares_object {
                if n_blocked == MAX_BLOCKED {
                    self.begin_noise();
                }
                continue;
            }
            self.nudge()?;
            let is_idle = runner.config.layout.task.grasps() && self.state.progress.is_idle();
            let is_blocked = n_blocked == MAX_BLOCKED || is_idle;
            if is_blocked {
                n_blocked = 0;
                self.state.progress.start_again();
            }
            if is_blocked || self.state.parked.contains(&true) {
                let objects = self.rig.observe_objects()?;
                match runner.next_action(&objects, start, &mut self.state, is_blocked) {
                    NextAction::Same => {}
                    NextAction::Parks(parks) => {
                        self.retreat(&parks)?;
                        self.state.parked = parks;
                        n_in_episode = 0;
                    }
                    NextAction::NextEpisode => {
                        self.start_next_episode()?;
                        n_in_episode = 0;
                    }
                }
            }
        }
    }

    /// Lets the objects come to rest, and returns whether they stay at their goals. An object that all arms share is
    /// not observed again.
    fn stay_placed(&mut self) -> Result<bool, FailureCause> {
        self.rig.wait(REST_S)?;
        if self.runner.task.shares_object() {
            return Ok(true);
        }
        let objects = self.rig.observe_objects()?;
        Ok(!self.runner.misplaced(&objects, self.start).any(|misplaced| misplaced))
    }

    /// Adds noise to the actions from now on.
    fn begin_noise(&mut self) {
        let (seed, number) = (self.runner.config.seed, self.start.number);
        self.state.noise.get_or_insert_with(|| episode_rng(seed, number, Stream::Exploration));
    }

    /// Withdraws the arms whose objects are not at their goals, and decides again which of them waits.
    fn start_next_episode(&mut self) -> Result<(), FailureCause> {
        let (runner, start) = (self.runner, self.start);
        let objects = self.rig.observe_objects()?;
        let misplaced: Vec<bool> = runner.misplaced(&objects, start).collect();
        self.retreat(&misplaced)?;
        self.recall()?;
        self.state.parked.fill(false);
        self.state.before = None;
        self.begin_noise();
        self.order_arms()
    }

    /// Opens the grippers of the `retreating` arms unless they hold an object above the table, raises their hands and
    /// withdraws them toward their bases, as far as the check allows.
    pub(super) fn retreat(&mut self, retreating: &[bool]) -> Result<(), FailureCause> {
        let runner = self.runner;
        let objects = self.rig.observe_objects()?;
        let blocks = runner.observed_blocks(&objects, None);
        let grasps = runner.config.layout.task.grasps();
        let open_m = if grasps { runner.mapping.max_opening_m() } else { 0.0 };
        let lifted: Vec<bool> = runner.lying(&objects).map(|lies| !lies).collect();
        let raised = |hand: DVec3| runner.mapping.reachable_hand(hand + DVec3::Z * RISE_M);
        let withdrawn = |hand: DVec3| runner.mapping.withdrawn_hand(hand);
        let targets: [&dyn Fn(DVec3) -> DVec3; 3] = [&|hand| hand, &raised, &withdrawn];
        for target in targets {
            let mut hands = runner.hands(&self.state);
            let mut openings_m = self.state.openings_m.clone();
            for arm in (0..hands.len()).filter(|arm| retreating[*arm]) {
                hands[arm] = target(hands[arm]);
                if !lifted[arm] {
                    openings_m[arm] = open_m;
                }
            }
            let wanted = WantedStep { hands, openings_m, blocks: &blocks };
            self.attempt(&wanted, &wanted.hands, &runner.check)?;
        }
        self.state.velocities.fill(DVec3::ZERO);
        Ok(())
    }
}

impl TrialRunner {
    /// Decides which arms make way: those whose objects lie at their goals on the table. If there are none and the arms
    /// block each other, one arm waits for its turn, at first the one whose object is farther from its goal, the next
    /// time the other one; an arm whose object is at its goal above the table waits before one whose object is not. Its
    /// turn comes when the object of the other one lies at its goal.
    fn next_action(
        &self,
        objects: &[ObjectPose],
        start: &TrialStart,
        state: &mut LoopState,
        is_blocked: bool,
    ) -> NextAction {
        let misplaced: Vec<bool> = self.misplaced(objects, start).collect();
        let is_waiting =
            misplaced.iter().zip(&state.parked).any(|(misplaced, parked)| *misplaced && *parked);
        let parks = self.parking(objects, &misplaced, state);
        if (is_blocked || is_waiting) && parks.contains(&true) {
            return NextAction::Parks(parks);
        }
        if !is_blocked {
            return NextAction::Same;
        }
        match self.goal_distances_m(objects, start)[..] {
            [one_m, other_m] if !state.parked.contains(&true) => {
                let farther = usize::from(other_m > one_m);
                // An arm that holds its object at a goal above the table waits for the other one.
                let is_other_placed = misplaced[farther] && !misplaced[1 - farther];
                let waiting = (farther + usize::from(is_other_placed) + state.n_waits) % 2;
                state.n_waits += 1;
                NextAction::Parks(vec![waiting == 0, waiting == 1])
            }
            _ => NextAction::NextEpisode,
        }
    }

    /// Returns the arms that are not parked and whose objects are not `misplaced` and lie on the table.
    fn parking(&self, objects: &[ObjectPose], misplaced: &[bool], state: &LoopState) -> Vec<bool> {
        let parks = misplaced.iter().zip(self.lying(objects)).zip(&state.parked);
        parks.map(|((misplaced, lies), parked)| !misplaced && lies && !parked).collect()
    }

    /// Returns for each arm whether its object lies on the table.
    pub(super) fn lying(&self, objects: &[ObjectPose]) -> impl Iterator<Item = bool> {
        objects.iter().enumerate().map(|(arm, object)| {
            let height_m = self.mapping.object_in_arm(ArmIndex(arm), object.at_m).z;
            height_m - self.config.trained_half_m < LYING_HEIGHT_M
        })
    }

    /// Replaces what the policy wants of parked arms: they stay where they are.
    pub(super) fn keep_parked(&self, state: &mut LoopState, wanted: &mut WantedStep<'_>) {
        let hands = self.hands(state);
        for arm in (0..hands.len()).filter(|arm| state.parked[*arm]) {
            wanted.hands[arm] = hands[arm];
            wanted.openings_m[arm] = state.openings_m[arm];
            state.velocities[arm] = DVec3::ZERO;
        }
    }

    /// Returns for each arm whether its object is away from its goal.
    pub(super) fn misplaced(
        &self,
        objects: &[ObjectPose],
        start: &TrialStart,
    ) -> impl Iterator<Item = bool> {
        let near_m = DONE_SHARE * self.tolerance_m();
        self.goal_distances_m(objects, start).into_iter().map(move |distance_m| distance_m > near_m)
    }
}

impl LoopState {
    /// Adds noise to `action` once it has [begun](ClosedLoop::begin_noise).
    pub(super) fn explore(&mut self, action: &mut [f32]) {
        if let Some(noise) = &mut self.noise {
            add_noise(noise, action);
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use tandem_core::Task;

    use super::*;
    use crate::trial::rig::{Goals, TrialRig};
    use crate::trial::runner::start_angles;
    use crate::trial::{NoObserver, TrialMode, test_config};

    #[test]
    fn arms_that_share_an_object_and_cannot_move_play_one_episode() {
        let config = test_config(Task::CarryBar, TrialMode::ClosedLoop, 1);
        let mut runner = TrialRunner::new(config).unwrap();
        let start = runner.start(0).unwrap();
        let joint_angles = start_angles(&runner.mapping, &start).unwrap();
        // Arms are never that far apart, so each motion is refused.
        runner.check.arms_gap_m = 10.0;
        runner.step_check.arms_gap_m = 10.0;
        let pair = runner.pair(&start, &joint_angles, 0, &runner.config.simulated);
        let (cell, mut observer) = (runner.mapping.cell().clone(), NoObserver);
        let mut rig = TrialRig::new(cell, pair, Goals::default(), &mut observer).unwrap();
        let mut up = |_: &[f32], _: &[f32], action: &mut [f32]| action.fill(1.0);
        let closed_loop = ClosedLoop::new(&runner, &mut rig, &start, &joint_angles, &mut up);
        let execution = closed_loop.run();
        assert_eq!(execution.ended, Ok(()));
        assert!(!execution.timed_out && execution.n_shortened >= MAX_BLOCKED);
        let n_steps = execution.n_steps;
        let n_most = 2 * runner.task.episode_steps() + MAX_BLOCKED;
        assert!((runner.task.episode_steps()..=n_most).contains(&n_steps), "{n_steps} steps");
    }

    #[test]
    fn parked_arms_stay_whatever_the_policy_wants() {
        let config = test_config(Task::SharedPickAndPlace, TrialMode::ClosedLoop, 1);
        let mut runner = TrialRunner::new(config).unwrap();
        let start = runner.start(0).unwrap();
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &joint_angles);
        state.parked[1] = true;
        let hands = runner.hands(&state);
        let moved: Vec<DVec3> = hands.iter().map(|hand| *hand + DVec3::X * 0.05).collect();
        let mut wanted =
            WantedStep { hands: moved.clone(), openings_m: vec![0.01; 2], blocks: &[] };
        runner.keep_parked(&mut state, &mut wanted);
        assert_eq!(wanted.hands, [moved[0], hands[1]]);
        assert_eq!(wanted.openings_m, [0.01, start.opening_m]);
    }

    #[test]
    fn arms_that_block_each_other_take_turns() {
        let config = test_config(Task::SharedPush, TrialMode::ClosedLoop, 1);
        let mut runner = TrialRunner::new(config).unwrap();
        let start = runner.start(0).unwrap();
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &joint_angles);
        let objects = |distances_m: [f64; 2]| {
            let pose = |(arm, distance_m): (usize, f64)| {
                let in_arm = start.goals[arm] + DVec3::X * distance_m;
                let at_m = runner.mapping.object_in_world(ArmIndex(arm), in_arm);
                ObjectPose { at_m, orientation: DQuat::IDENTITY, time_s: 0.0 }
            };
            distances_m.into_iter().enumerate().map(pose).collect::<Vec<_>>()
        };
        let neither = objects([0.1, 0.2]);
        let mut next = |objects: &[ObjectPose], parked: [bool; 2], is_blocked| {
            state.parked = parked.to_vec();
            runner.next_action(objects, &start, &mut state, is_blocked)
        };
        let parks = |arms: [bool; 2]| NextAction::Parks(arms.to_vec());
        assert_eq!(next(&neither, [false; 2], false), NextAction::Same);
        assert_eq!(next(&neither, [false; 2], true), parks([false, true]), "the farther one waits");
        assert_eq!(next(&neither, [false, true], false), NextAction::Same);
        let first = objects([0.0, 0.2]);
        assert_eq!(
            next(&first, [false, true], false),
            parks([true, false]),
            "the other one's turn"
        );
        assert_eq!(next(&first, [true, false], false), NextAction::Same, "nothing waits");
        assert_eq!(
            next(&neither, [false, true], true),
            NextAction::NextEpisode,
            "blocked although one waits"
        );
        assert_eq!(next(&neither, [false; 2], true), parks([true, false]), "roles alternate");
        assert_eq!(next(&first, [false; 2], true), parks([true, false]), "placed ones make way");
    }

    #[test]
    fn an_arm_with_its_object_at_a_goal_above_the_table_waits_first() {
        let config = test_config(Task::SharedPickAndPlace, TrialMode::ClosedLoop, 1);
        let mut runner = TrialRunner::new(config).unwrap();
        let mut start = runner.start(0).unwrap();
        start.goals[0].z = 0.15;
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &joint_angles);
        let in_arm = [start.goals[0], start.goals[1] + DVec3::X * 0.2];
        let pose = |arm: usize| {
            let at_m = runner.mapping.object_in_world(ArmIndex(arm), in_arm[arm]);
            ObjectPose { at_m, orientation: DQuat::IDENTITY, time_s: 0.0 }
        };
        let objects = [0, 1].map(pose);
        assert_eq!(runner.lying(&objects).next(), Some(false));
        let next = runner.next_action(&objects, &start, &mut state, true);
        assert_eq!(next, NextAction::Parks(vec![true, false]), "the misplaced one is farther");
    }
}
