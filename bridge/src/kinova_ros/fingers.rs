//! When a gripper gets a new goal. Pure.
//!
//! kinova-ros moves fingers by an action whose goal is a point in the arm's own queue: it holds the arm where it was told to be
//! last, and velocities that come meanwhile wait behind it. A goal that replaces another, and one that ends
//! because the fingers are stalled, restart the arm's interface. So here:
//!
//! - a goal is sent only while the arm is told to stand, and no goal while another one is under way;
//! - while one is under way the arm gets no velocities, and so stands;
//! - a goal is sent when the wanted opening is a step away from the last goal, or has rested somewhere else for a while.

/// When goals are sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FingerSettings {
    /// Turns (kinova-ros' unit of a finger's way) of a gripper that is shut; open is 0. Kinova gives 6400 as a good value and
    /// 6800 as the end of the thread. Default 6400.
    pub shut_turns: f64,
    /// Change of the opening, 0 to 1, that is worth a goal at once. Default 0.05.
    pub step: f64,
    /// Change of the opening that is worth a goal when it stays; the action itself is content within 0.01. Default 0.015.
    pub rest: f64,
    /// Exchanges from one goal to the next at least, and those after which an opening has come to rest. Default 20.
    pub pause_exchanges: u32,
    /// Exchanges after which a goal without a result is given up. Default 1000.
    pub patience_exchanges: u32,
    /// An arm stands when no joint is told to move faster than this, radians per second. Default 0.5 degrees per second.
    pub standing_radps: f64,
}

impl Default for FingerSettings {
    fn default() -> Self {
        Self {
            shut_turns: 6400.0,
            step: 0.05,
            rest: 0.015,
            pause_exchanges: 20,
            patience_exchanges: 1000,
            standing_radps: 0.5_f64.to_radians(),
        }
    }
}

/// The goals of one gripper.
#[derive(Debug, Clone)]
pub(crate) struct Fingers {
    settings: FingerSettings,
    /// Opening of the last goal, or what it was when the arm was let go.
    at: Option<f64>,
    /// The goal that is under way, and for how many exchanges.
    under_way: Option<(String, u32)>,
    wanted: f64,
    /// Exchanges for which the wanted opening has not changed.
    n_rested: u32,
    /// Exchanges since the last goal.
    n_since: u32,
}

impl Fingers {
    pub(crate) fn new(settings: FingerSettings) -> Self {
        let n_since = settings.pause_exchanges;
        Self { settings, at: None, under_way: None, wanted: 0.0, n_rested: 0, n_since }
    }

    /// The arm was stopped: goals have ended, and what it holds is what it shall hold.
    pub(crate) fn stop(&mut self) {
        *self = Self::new(self.settings);
    }

    /// Whether a goal is under way, so that the arm must not be told to move.
    pub(crate) fn busy(&self) -> bool {
        self.under_way.is_some()
    }

    /// The goal of this name was sent.
    pub(crate) fn sent(&mut self, id: String) {
        self.under_way = Some((id, 0));
        self.at = Some(self.wanted);
        self.n_since = 0;
    }

    /// The goal of this name has ended.
    pub(crate) fn ended(&mut self, id: &str) {
        self.under_way.take_if(|(name, _)| name == id);
    }

    /// Lets an exchange pass in which the gripper shall be open by `wanted` and the arm stands or does not. The opening of a goal, when
    /// it is time for one.
    pub(crate) fn next(&mut self, wanted: f64, stands: bool) -> Option<f64> {
        let settings = self.settings;
        let rested = (wanted - self.wanted).abs() < 1e-6;
        self.n_rested = if rested { self.n_rested.saturating_add(1) } else { 0 };
        self.n_since = self.n_since.saturating_add(1);
        self.wanted = wanted;
        if let Some((_, n)) = &mut self.under_way {
            *n += 1;
            if *n > settings.patience_exchanges {
                self.under_way = None;
            }
            return None;
        }
        let change = (wanted - *self.at.get_or_insert(wanted)).abs();
        let rests = self.n_rested >= settings.pause_exchanges && change >= settings.rest;
        let due = stands && self.n_since >= settings.pause_exchanges;
        (due && (change >= settings.step || rests)).then_some(wanted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Openings of goals and the exchanges in which they were sent; each is under way for `lasts` exchanges.
    fn goals(
        wanted: impl Fn(u32) -> f64,
        stands: impl Fn(u32) -> bool,
        lasts: u32,
    ) -> Vec<(u32, f64)> {
        let mut fingers = Fingers::new(FingerSettings::default());
        let (mut goals, mut ends) = (Vec::new(), None);
        for n in 0..400 {
            if ends == Some(n) {
                fingers.ended(&n.to_string());
            }
            if let Some(opening) = fingers.next(wanted(n), stands(n)) {
                assert!(!fingers.busy() && stands(n));
                fingers.sent((n + lasts).to_string());
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
    fn a_goal_without_a_result_is_given_up() {
        let settings = FingerSettings { patience_exchanges: 50, ..FingerSettings::default() };
        let mut fingers = Fingers::new(settings);
        fingers.next(1.0, true);
        let first = (0..).find(|_| fingers.next(0.0, true).is_some()).unwrap();
        assert!(first <= 20);
        fingers.sent("a".into());
        fingers.ended("b");
        assert!(fingers.busy());
        let n = (1..200).find(|_| fingers.next(0.0, true).is_none() && !fingers.busy());
        assert_eq!(n, Some(51));
    }

    #[test]
    fn a_stopped_arm_keeps_what_it_holds() {
        let mut fingers = Fingers::new(FingerSettings::default());
        fingers.next(1.0, true);
        fingers.sent("a".into());
        fingers.stop();
        assert!(!fingers.busy());
        for _ in 0..100 {
            assert_eq!(fingers.next(0.4, true), None);
        }
    }
}
