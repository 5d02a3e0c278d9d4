//! Checks that an arm follows the velocities that its node received. Pure.
//!
//! kinova-ros does not report which velocities it has passed on to the arm. Its one thread also reads the arm's state,
//! with many slow calls, and keeps only the newest velocity meanwhile. The driver's own velocities return through ROS
//! in any case, so they prove nothing. What the arm has consumed shows in its motion only: every 10 ms, an arm turns by
//! one velocity for 10 ms, or rests if it has none.
//!
//! Therefore the turn of each joint between two states is compared with the velocities of a time span of the same
//! length. Their delay is not known exactly: the span that asks for the smallest turn counts, over all delays up to
//! [`MAX_DELAY`] exchanges. Slow arms, turns of less than [`LEAST_RAD`] and arms that accelerate pass.

use std::collections::VecDeque;

use tandem_kinematics::Joints;

/// The largest delay of measured angles behind velocities, in exchanges.
const MAX_DELAY: usize = 15;
/// Shortest and longest time between the two states, seconds.
const SPAN_S: [f64; 2] = [0.25, 0.80];
/// Smallest commanded turn of a joint that is judged, radians.
const LEAST_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;
/// Smallest share of the velocities that an arm has to follow.
pub(crate) const LEAST_SHARE: f64 = 0.65;
/// Exchanges that are kept.
const N_KEPT: usize = 100;

/// The velocities and the motion of one arm.
#[derive(Debug, Clone)]
pub(crate) struct Following {
    period_s: f64,
    /// The sum of all velocities after each exchange, as angles in radians; the newest first.
    sums: VecDeque<Joints>,
    /// Time stamps (seconds) and angles (radians) of states, and the exchanges since each; the newest first.
    states: VecDeque<(f64, Joints)>,
}

/// A joint that turned by less than its velocities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Shortfall {
    /// The joint, counted from 0.
    pub(crate) joint: usize,
    /// The measured share of the commanded turn.
    pub(crate) share: f64,
    /// The time span, seconds.
    pub(crate) span_s: f64,
}

impl Following {
    pub(crate) fn new(period_s: f64) -> Self {
        Self { period_s, sums: VecDeque::new(), states: VecDeque::new() }
    }

    /// Forgets everything, because the arm was stopped.
    pub(crate) fn clear(&mut self) {
        self.sums.clear();
        self.states.clear();
    }

    /// Adds the velocities of an exchange, radians per second; zero if none were published.
    pub(crate) fn push_velocities(&mut self, velocities: &Joints) {
        let sum = |joint: usize| {
            let before = self.sums.front().map_or(0.0, |sum| sum[joint]);
            before + velocities[joint] * self.period_s
        };
        let sum = Joints::from_fn(velocities.len(), sum);
        self.sums.push_front(sum);
        self.sums.truncate(N_KEPT);
    }

    /// Adds a state of the arm with its time stamp, seconds, and its joint angles, radians.
    ///
    /// # Errors
    /// Returns the joint that follows its velocities the least, if one falls short of them.
    pub(crate) fn push_state(&mut self, stamp_s: f64, angles: &Joints) -> Result<(), Shortfall> {
        let worst = self.states.iter().filter_map(|(earlier_s, from)| {
            let span_s = stamp_s - earlier_s;
            let turn = Joints::from_fn(angles.len(), |joint| angles[joint] - from[joint]);
            (SPAN_S[0]..=SPAN_S[1]).contains(&span_s).then(|| self.worst_of(span_s, &turn))?
        });
        let worst = worst.min_by(|a, b| a.share.total_cmp(&b.share));
        self.states.push_front((stamp_s, *angles));
        self.states.retain(|(earlier_s, _)| stamp_s - earlier_s <= SPAN_S[1]);
        match worst.filter(|worst| worst.share < LEAST_SHARE) {
            Some(shortfall) => Err(shortfall),
            None => Ok(()),
        }
    }

    /// Returns the joint that follows the least in a turn that took `span_s`.
    fn worst_of(&self, span_s: f64, turn: &Joints) -> Option<Shortfall> {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a span is at most 0.8 s"
        )]
        let n = (span_s / self.period_s).round() as usize;
        if self.sums.len() <= n + MAX_DELAY {
            return None;
        }
        let judged = (0..turn.len()).filter_map(|joint| {
            let commanded = |delay: usize| self.sums[delay][joint] - self.sums[delay + n][joint];
            let direction = commanded(0).signum();
            let least = (0..=MAX_DELAY)
                .map(|delay| direction * commanded(delay))
                .fold(f64::INFINITY, f64::min);
            let share = direction * turn[joint] / least;
            (least >= LEAST_RAD).then_some(Shortfall { joint, share, span_s })
        });
        judged.min_by(|a, b| a.share.total_cmp(&b.share))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_S: f64 = 0.01;

    /// Plays velocities (degrees per second, by exchange) with an arm that takes those that `takes` accepts `delay`
    /// exchanges later, and reports every fifth exchange.
    fn play(
        velocity: impl Fn(usize) -> f64,
        takes: impl Fn(usize) -> bool,
        delay: usize,
    ) -> Result<(), Shortfall> {
        let mut following = Following::new(PERIOD_S);
        let mut angle = 1.0;
        for n in 0..200 {
            following.push_velocities(&Joints::new(&[0.0, velocity(n).to_radians(), 0.0, 0.0]));
            if n >= delay && takes(n) {
                angle += velocity(n - delay).to_radians() * PERIOD_S;
            }
            if n % 5 == 0 {
                let stamp_s = n as f64 * PERIOD_S;
                following.push_state(stamp_s, &Joints::new(&[0.5, angle, 0.0, 0.0]))?;
            }
        }
        Ok(())
    }

    /// From rest to `fastest` and back within 2 s.
    fn ramps(fastest: f64) -> impl Fn(usize) -> f64 {
        move |n| fastest * (n.min(200 - n) as f64 / 25.0).min(1.0)
    }

    #[test]
    fn an_arm_with_any_delay_passes() {
        for delay in 0..MAX_DELAY {
            for fastest in [3.0, 36.0, -36.0] {
                assert_eq!(play(ramps(fastest), |_| true, delay), Ok(()), "{delay} {fastest}");
            }
            let turns = |n: usize| 30.0 * (n as f64 * 0.06).sin();
            assert_eq!(play(turns, |_| true, delay), Ok(()), "{delay}");
        }
    }

    #[test]
    fn a_few_lost_velocities_pass_and_half_of_them_do_not() {
        assert_eq!(play(ramps(20.0), |n| n % 5 != 0, 3), Ok(()));
        for fastest in [8.0, 20.0, -20.0] {
            let shortfall = play(ramps(fastest), |n| n % 2 == 0, 3).unwrap_err();
            assert_eq!(shortfall.joint, 1);
            assert!((0.35..0.65).contains(&shortfall.share), "{shortfall:?}");
        }
        let blocked = play(ramps(20.0), |_| false, 3).unwrap_err();
        assert_eq!(blocked.share, 0.0);
    }

    #[test]
    fn velocities_before_a_stop_do_not_count() {
        let mut following = Following::new(PERIOD_S);
        for n in 0..100 {
            following.push_velocities(&Joints::new(&[0.5, 0.0, 0.0, 0.0]));
            if n == 50 {
                following.clear();
            }
        }
        let still = Joints::new(&[1.0; 4]);
        assert_eq!(following.push_state(0.0, &still), Ok(()));
        assert_eq!(following.push_state(0.40, &still), Ok(()));
    }
}
