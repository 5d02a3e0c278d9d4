//! What is made of the times and counts that were measured. Pure.

use std::time::Duration;

/// Less gain in throughput than this is none.
const GAIN: f64 = 1.1;
/// A thread that computes for so much of the time leaves no more room.
const BUSY: f64 = 0.8;

/// The time that `share` of `times` do not exceed; 0 when there are none.
pub(super) fn quantile(times: &mut [Duration], share: f64) -> Duration {
    times.sort_unstable();
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "an index below the number of times"
    )]
    let rank = (times.len() as f64 * share).ceil() as usize;
    times.get(rank.saturating_sub(1)).copied().unwrap_or_default()
}

/// The median and the longest of the times between moments that follow one another; `None` for fewer than two.
pub(super) fn median_and_longest(moments: &[Duration]) -> Option<(Duration, Duration)> {
    let mut spans: Vec<Duration> =
        moments.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).collect();
    let longest = spans.iter().max().copied()?;
    Some((quantile(&mut spans, 0.5), longest))
}

/// The first of `points` (workers and throughput, by rising number of workers) that no later one exceeds by a tenth;
/// `None` when that is the last one, and it is open how much more would help.
pub(super) fn knee(points: &[(usize, f64)]) -> Option<usize> {
    let is_knee = |idx: &usize| {
        points[idx + 1..].iter().all(|(_, throughput)| *throughput < GAIN * points[*idx].1)
    };
    (0..points.len().saturating_sub(1)).find(is_knee)
}

/// Cores that were busy.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Load {
    /// The learner's thread of sockets.
    pub(super) serving: f64,
    /// The learner's other threads.
    pub(super) learning: f64,
    /// The workers together.
    pub(super) workers: f64,
    /// The machine, others' work included.
    pub(super) machine: f64,
    /// Cores that there are.
    pub(super) n_cores: f64,
}

/// What keeps more workers from bringing more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Bound {
    /// Cores for the workers' simulation.
    Simulation,
    /// The learner's updates, and taking in a round.
    Update,
    /// The learner's thread of sockets.
    Wire,
    /// Nobody is at work all the time: everybody waits for the slowest of a round.
    Rounds,
}

impl Bound {
    /// What is busy. A machine without an idle core is bound by whoever of ours takes most of it.
    pub(super) fn of(load: &Load) -> Self {
        let Load { serving, learning, workers, machine, n_cores } = *load;
        if serving >= BUSY {
            return Self::Wire;
        }
        if machine < BUSY * n_cores {
            return if learning >= BUSY { Self::Update } else { Self::Rounds };
        }
        if workers >= learning && workers >= serving {
            Self::Simulation
        } else if learning >= serving {
            Self::Update
        } else {
            Self::Wire
        }
    }

    pub(super) const fn words(self) -> &'static str {
        match self {
            Self::Simulation => "simulation: no core is left for more workers",
            Self::Update => "updates: the learner's own computing takes the time",
            Self::Wire => "wire: the learner's thread of sockets takes the time",
            Self::Rounds => "rounds: everybody waits for the slowest slot of a round",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn millis(times: &[u64]) -> Vec<Duration> {
        times.iter().copied().map(Duration::from_millis).collect()
    }

    #[test]
    fn a_quantile_is_one_of_the_times() {
        let check = |times: &[u64], share, expected| {
            let got = quantile(&mut millis(times), share);
            assert_eq!(got, Duration::from_millis(expected), "{share} of {times:?}");
        };
        check(&[], 0.5, 0);
        check(&[7], 0.5, 7);
        check(&[7], 0.99, 7);
        check(&[30, 10, 20], 0.5, 20);
        check(&[40, 10, 30, 20], 0.5, 20);
        check(&(1..=100).rev().collect::<Vec<_>>(), 0.99, 99);
        check(&(1..=100).collect::<Vec<_>>(), 1.0, 100);
    }

    #[test]
    fn a_stall_shows_beside_the_median() {
        assert_eq!(median_and_longest(&millis(&[5])), None);
        let expected = Some((Duration::from_millis(100), Duration::from_millis(900)));
        assert_eq!(median_and_longest(&millis(&[0, 100, 190, 1090, 1200])), expected);
    }

    #[test]
    fn the_knee_is_where_no_more_workers_bring_a_tenth_more() {
        let check = |throughputs: &[f64], expected: Option<usize>| {
            let points: Vec<_> = throughputs.iter().copied().enumerate().collect();
            assert_eq!(knee(&points), expected, "{throughputs:?}");
        };
        check(&[], None);
        check(&[100.0], None);
        check(&[100.0, 200.0, 400.0], None);
        check(&[100.0, 200.0, 210.0, 205.0], Some(1));
        check(&[100.0, 90.0, 80.0], Some(0));
        // A dip is not the knee when more workers bring more after all.
        check(&[100.0, 95.0, 150.0, 151.0], Some(2));
        // Small gains that add up are gains.
        check(&[100.0, 108.0, 116.0, 117.0], Some(1));
    }

    #[test]
    fn the_bound_is_what_is_busy() {
        let idle = Load { serving: 0.1, learning: 0.1, workers: 0.1, machine: 0.4, n_cores: 4.0 };
        let check = |load, expected| assert_eq!(Bound::of(&load), expected, "{load:?}");
        check(idle, Bound::Rounds);
        check(Load { serving: 0.9, machine: 1.2, ..idle }, Bound::Wire);
        check(Load { learning: 1.0, machine: 1.3, ..idle }, Bound::Update);
        check(Load { workers: 3.5, machine: 3.9, ..idle }, Bound::Simulation);
        check(Load { learning: 2.0, workers: 1.0, machine: 3.9, ..idle }, Bound::Update);
        check(Load { serving: 0.7, workers: 0.6, machine: 3.9, ..idle }, Bound::Wire);
    }
}
