//! The goals of a gripper. Pure.
//!
//! kinova-ros moves fingers by an action whose goal is a point in the arm's own queue. The point holds the arm in
//! place, and velocities that arrive meanwhile wait behind it. A goal that replaces another one, and a goal that ends
//! because the fingers stall, restart the arm's interface. Therefore:
//!
//! - a goal is sent only while the arm is commanded to be stationary and no other goal is active;
//! - the arm receives no velocities while a goal is active, so it is stationary;
//! - a goal is sent if the desired opening differs from the last goal by a step, or by less and has not changed for a
//!   while.

/// The conditions under which goals are sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FingerSettings {
    /// Turns (kinova-ros' unit of a finger's position) of a closed gripper; open is 0. Kinova recommends 6400; the
    /// thread ends at 6800. Default 6400.
    pub shut_turns: f64,
    /// Change of the opening, 0 to 1, that causes a goal at once. Default 0.05.
    pub step: f64,
    /// Change of the opening that causes a goal once it persists; the action's own tolerance is 0.01. Default 0.015.
    pub rest: f64,
    /// Smallest number of exchanges between two goals, and the number after which a change persists. Default 20.
    pub pause_exchanges: u32,
    /// Exchanges within which a goal must end. Default 1000.
    pub timeout_exchanges: u32,
    /// Highest commanded speed of the joints of a stationary arm, radians per second. Default 0.5 degrees per second.
    pub stationary_radps: f64,
}

impl Default for FingerSettings {
    fn default() -> Self {
        Self {
            shut_turns: 6400.0,
            step: 0.05,
            rest: 0.015,
            pause_exchanges: 20,
            timeout_exchanges: 1000,
            stationary_radps: 0.5_f64.to_radians(),
        }
    }
}

/// The goals of one gripper.
#[derive(Debug, Clone)]
pub(crate) struct Fingers {
    settings: FingerSettings,
    /// The opening of the last goal, or the initial one after a reset.
    at: Option<f64>,
    /// The active goal and the number of exchanges since it was sent.
    active: Option<(String, u32)>,
    wanted: f64,
    /// Exchanges since the desired opening has changed.
    n_unchanged: u32,
    /// Exchanges since the last goal.
    n_since: u32,
}

impl Fingers {
    pub(crate) fn new(settings: FingerSettings) -> Self {
        let n_since = settings.pause_exchanges;
        Self { settings, at: None, active: None, wanted: 0.0, n_unchanged: 0, n_since }
    }

    /// Forgets all goals, because the arm was stopped. The gripper keeps its position.
    pub(crate) fn stop(&mut self) {
        *self = Self::new(self.settings);
    }

    /// Returns true if a goal is active, so that the arm must receive no velocities.
    pub(crate) fn busy(&self) -> bool {
        self.active.is_some()
    }

    /// Returns true if the active goal has had no result for too long. It may still be in the arm's queue.
    pub(crate) fn is_overdue(&self) -> bool {
        self.active.as_ref().is_some_and(|(_, n)| *n > self.settings.timeout_exchanges)
    }

    /// Records that goal `id` was sent.
    pub(crate) fn goal_sent(&mut self, id: String) {
        self.active = Some((id, 0));
        self.at = Some(self.wanted);
        self.n_since = 0;
    }

    /// Records that goal `id` has ended.
    pub(crate) fn goal_ended(&mut self, id: &str) {
        self.active.take_if(|(name, _)| name == id);
    }

    /// Counts an exchange with the desired opening `wanted`. Returns the opening of a new goal if one is due.
    pub(crate) fn next(&mut self, wanted: f64, stationary: bool) -> Option<f64> {
        let settings = self.settings;
        let rested = (wanted - self.wanted).abs() < 1e-6;
        self.n_unchanged = if rested { self.n_unchanged.saturating_add(1) } else { 0 };
        self.n_since = self.n_since.saturating_add(1);
        self.wanted = wanted;
        if let Some((_, n)) = &mut self.active {
            *n = n.saturating_add(1);
            return None;
        }
        let change = (wanted - *self.at.get_or_insert(wanted)).abs();
        let rests = self.n_unchanged >= settings.pause_exchanges && change >= settings.rest;
        let due = stationary && self.n_since >= settings.pause_exchanges;
        (due && (change >= settings.step || rests)).then_some(wanted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Openings of goals and the exchanges in which they were sent; each is under way for `lasts` exchanges.
    fn goals(
        wanted: impl Fn(u32) -> f64,
        stationary: impl Fn(u32) -> bool,
        lasts: u32,
    ) -> Vec<(u32, f64)> {
        let mut fingers = Fingers::new(FingerSettings::default());
        let (mut goals, mut ends) = (Vec::new(), None);
        for n in 0..400 {
            if ends == Some(n) {
                fingers.goal_ended(&n.to_string());
            }
            if let Some(opening) = fingers.next(wanted(n), stationary(n)) {
                assert!(!fingers.busy() && stationary(n));
                fingers.goal_sent((n + lasts).to_string());
                ends = Some(n + lasts);
                goals.push((n, opening));
            }
        }
        goals
    }

    #[test]
    fn an_opening_that_does_not_change_needs_no_goal() {
        assert_eq!(goals(|_| 0.3, |_| true, 10), []);
        assert_eq!(goals(|n| if n < 50 { 0.3 } else { 0.31 }, |_| true, 10), []);
    }

    #[test]
    fn a_ramp_becomes_few_goals_and_the_last_one_is_its_end() {
        let ramp = |n: u32| 1.0 - 0.01 * f64::from(n.clamp(50, 120) - 50);
        let got = goals(ramp, |_| true, 15);
        let at: Vec<u32> = got.iter().map(|(n, _)| *n).collect();
        assert!(at.windows(2).all(|pair| pair[1] - pair[0] >= 20), "{got:?}");
        assert!(got.len() <= 6 && got[0].1 <= 0.95, "{got:?}");
        assert!((got[got.len() - 1].1 - 0.3).abs() < 0.016, "{got:?}");
    }

    #[test]
    fn no_goal_goes_out_while_the_arm_moves_or_another_is_under_way() {
        let wanted = |n: u32| if n < 20 { 1.0 } else { 0.2 };
        assert_eq!(goals(wanted, |n| !(10..=200).contains(&n), 10), [(201, 0.2)]);
        let twice = |n: u32| [1.0, 0.2, 0.6][(n / 30).min(2) as usize];
        assert_eq!(goals(twice, |_| true, 150), [(30, 0.2), (180, 0.6)]);
    }

    #[test]
    fn a_goal_without_a_result_is_overdue_and_stays_active() {
        let settings = FingerSettings { timeout_exchanges: 50, ..FingerSettings::default() };
        let mut fingers = Fingers::new(settings);
        fingers.next(1.0, true);
        let first = (0..).find(|_| fingers.next(0.0, true).is_some()).unwrap();
        assert!(first <= 20);
        fingers.goal_sent("a".into());
        fingers.goal_ended("b");
        assert!(fingers.busy());
        let n = (1..200).find(|_| fingers.next(0.0, true).is_none() && fingers.is_overdue());
        assert_eq!(n, Some(51));
        assert!(fingers.busy());
    }

    #[test]
    fn a_stopped_arm_keeps_what_it_holds() {
        let mut fingers = Fingers::new(FingerSettings::default());
        fingers.next(1.0, true);
        fingers.goal_sent("a".into());
        fingers.stop();
        assert!(!fingers.busy());
        for _ in 0..100 {
            assert_eq!(fingers.next(0.4, true), None);
        }
    }
}
