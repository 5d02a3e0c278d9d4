//! Statistics of the measurements. Pure.

use std::time::Duration;

use tandem_bench::quantile;

/// Throughput gains below 10 % count as saturation.
const MIN_GAIN: f64 = 1.1;
/// Load above which a thread, or the machine, counts as saturated.
const SATURATED: f64 = 0.8;

/// Returns the median and the longest of the spans between successive moments; `None` for fewer than two moments.
pub(super) fn median_and_longest(moments: &[Duration]) -> Option<(Duration, Duration)> {
    let mut spans: Vec<Duration> =
        moments.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).collect();
    let longest = spans.iter().max().copied()?;
    Some((quantile(&mut spans, 0.5), longest))
}

/// Returns the index of the first of `points` (number of workers, in ascending order, and throughput) that no later one
/// exceeds by 10 %; `None` if that is the last one, so that the knee is not reached.
pub(super) fn knee(points: &[(usize, f64)]) -> Option<usize> {
    let is_knee = |idx: &usize| {
        points[idx + 1..].iter().all(|(_, throughput)| *throughput < MIN_GAIN * points[*idx].1)
    };
    (0..points.len().saturating_sub(1)).find(is_knee)
}

/// Number of busy cores.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Load {
    /// Of the learner's socket thread.
    pub(super) serving: f64,
    /// Of the learner's other threads.
    pub(super) learning: f64,
    /// Of all workers.
    pub(super) workers: f64,
    /// Of the machine, including other programs.
    pub(super) machine: f64,
    /// Number of cores of the machine.
    pub(super) n_cores: f64,
}

/// The bottleneck that limits the throughput.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Bound {
    /// The cores, which the workers' simulations use.
    Simulation,
    /// The learner's updates.
    Update,
    /// The learner's socket thread.
    Wire,
    /// The rounds: all processes wait for the slowest slot.
    Rounds,
}

impl Bound {
    /// Determines the bottleneck. Without an idle core, it is the part of the run that uses most of the machine.
    pub(super) fn of(load: &Load) -> Self {
        let Load { serving, learning, workers, machine, n_cores } = *load;
        if serving >= SATURATED {
            return Self::Wire;
        }
        if machine < SATURATED * n_cores {
            return if learning >= SATURATED { Self::Update } else { Self::Rounds };
        }
        if workers >= learning && workers >= serving {
            Self::Simulation
        } else if learning >= serving {
            Self::Update
        } else {
            Self::Wire
        }
    }

    pub(super) const fn text(self) -> &'static str {
        match self {
            Self::Simulation => "simulation: no core is left for more workers",
            Self::Update => "updates: the learner's own computing takes the time",
            Self::Wire => "wire: the learner's thread of sockets takes the time",
            Self::Rounds => "rounds: all processes wait for the slowest slot of a round",
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
    fn a_stall_is_the_longest_span() {
        assert_eq!(median_and_longest(&millis(&[5])), None);
        let expected = Some((Duration::from_millis(100), Duration::from_millis(900)));
        assert_eq!(median_and_longest(&millis(&[0, 100, 190, 1090, 1200])), expected);
    }

    #[test]
    fn the_knee_is_where_more_workers_gain_less_than_a_tenth() {
        let check = |throughputs: &[f64], expected: Option<usize>| {
            let points: Vec<_> = throughputs.iter().copied().enumerate().collect();
            assert_eq!(knee(&points), expected, "{throughputs:?}");
        };
        check(&[], None);
        check(&[100.0], None);
        check(&[100.0, 200.0, 400.0], None);
        check(&[100.0, 200.0, 210.0, 205.0], Some(1));
        check(&[100.0, 90.0, 80.0], Some(0));
        // A dip is not the knee if more workers gain more.
        check(&[100.0, 95.0, 150.0, 151.0], Some(2));
        // Small gains add up.
        check(&[100.0, 108.0, 116.0, 117.0], Some(1));
    }

    #[test]
    fn the_bottleneck_is_the_saturated_part() {
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
