//! Results of the paper, which reports show beside those of Tandem's runs.

use tandem_core::Task;

/// Citation for the values of [`TABLE_2`] and [`TABLE_4`].
pub const SOURCE: &str = "H. Ren, P. Ben-Tzvi: Advising reinforcement learning toward scaling agents in continuous control \
     environments with sparse rewards. Engineering Applications of Artificial Intelligence, 2020, Tables 2 and 4; \
     https://doi.org/10.1016/j.engappai.2020.103515";

/// A row of the paper's Table 2.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaperRow {
    /// Name of the strategy in the paper.
    pub name: &'static str,
    /// Name of the strategy on Tandem's command line, without a threshold.
    pub strategy: &'static str,
    /// Threshold of the strategy; `None` if it has none or the paper does not state it.
    pub threshold: Option<f64>,
    /// Measures for push.
    pub push: PaperMeasures,
    /// Measures for pick and place.
    pub pick_and_place: PaperMeasures,
}

/// Measures of one strategy on one task, in the paper's epochs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaperMeasures {
    /// IE: the epoch at which success reaches 10 % of its maximum. `None` where the paper prints NaN.
    pub inspired_epoch: Option<f64>,
    /// RT: number of epochs from 10 % to 90 % of the maximum. `None` where the paper prints NaN.
    pub rising_epochs: Option<f64>,
    /// MSR: the maximum success, in [0, 1].
    pub max_success: f64,
    /// ELR: 90 % of the maximum, divided by the number of epochs until it was reached.
    pub learning_rate: f64,
}

/// The paper's Table 2.
pub const TABLE_2: [PaperRow; 12] = [
    PaperRow {
        name: "NA",
        strategy: "none",
        threshold: None,
        push: PaperMeasures {
            inspired_epoch: None,
            rising_epochs: None,
            max_success: 0.0,
            learning_rate: 0.0,
        },
        pick_and_place: measures(336.0, 489.0, 0.9219, 0.0010),
    },
    row("EA", "ea", None, [252.0, 363.0, 0.9333, 0.0014], [228.0, 96.0, 0.9750, 0.0027]),
    row("EAMC", "eamc", None, [116.0, 139.0, 0.9417, 0.0033], [135.0, 178.0, 0.9250, 0.0027]),
    row(
        "MC-Q001",
        "mc-q",
        Some(0.01),
        [140.0, 105.0, 0.9583, 0.0035],
        [220.0, 93.0, 0.9250, 0.0027],
    ),
    row(
        "MC-Q005",
        "mc-q",
        Some(0.05),
        [46.0, 195.0, 0.9583, 0.0036],
        [174.0, 156.0, 0.9417, 0.0026],
    ),
    row("MC-Q01", "mc-q", Some(0.1), [63.0, 229.0, 0.9583, 0.0030], [86.0, 209.0, 0.8417, 0.0026]),
    row(
        "MC-ACT001",
        "mc-act",
        Some(0.01),
        [214.0, 71.0, 0.9333, 0.0029],
        [225.0, 82.0, 0.9167, 0.0027],
    ),
    row(
        "MC-ACT005",
        "mc-act",
        Some(0.05),
        [215.0, 96.0, 0.9500, 0.0027],
        [224.0, 134.0, 0.9167, 0.0023],
    ),
    row(
        "MC-ACT01",
        "mc-act",
        Some(0.1),
        [216.0, 80.0, 0.9500, 0.0029],
        [226.0, 85.0, 0.9167, 0.0027],
    ),
    row(
        "MC-ACTABS001",
        "mc-act-abs",
        Some(0.01),
        [217.0, 101.0, 0.9625, 0.0027],
        [225.0, 104.0, 0.9167, 0.0025],
    ),
    row(
        "MC-ACTABS005",
        "mc-act-abs",
        Some(0.05),
        [214.0, 91.0, 0.9500, 0.0028],
        [229.0, 85.0, 0.9250, 0.0027],
    ),
    row(
        "MC-ACTABS01",
        "mc-act-abs",
        Some(0.1),
        [213.0, 104.0, 0.9500, 0.0027],
        [222.0, 108.0, 0.9083, 0.0025],
    ),
];

/// A row of the paper's Table 4: trials on two real arms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PaperTrials {
    /// Description of the policies in the paper.
    pub name: &'static str,
    /// Number of successes in [`N_PAPER_TRIALS`] trials of push.
    pub push: usize,
    /// Number of successes in [`N_PAPER_TRIALS`] trials of pick and place.
    pub pick_and_place: usize,
}

/// Number of trials of each policy in the paper's Table 4.
pub const N_PAPER_TRIALS: usize = 50;

/// The paper's Table 4.
pub const TABLE_4: [PaperTrials; 2] = [
    PaperTrials { name: "proposed method", push: 40, pick_and_place: 38 },
    PaperTrials { name: "from scratch", push: 0, pick_and_place: 30 },
];

impl PaperTrials {
    /// Returns the number of successes for `task`; `None` if the arms share an object, as in no task of the paper.
    #[must_use]
    pub const fn n_successes(&self, task: Task) -> Option<usize> {
        match (task.shares_object(), task.grasps()) {
            (true, _) => None,
            (false, true) => Some(self.pick_and_place),
            (false, false) => Some(self.push),
        }
    }
}

impl PaperRow {
    /// Returns the row of a strategy such as `mc-q:0.05`, as it is written on the command line, and its index.
    #[must_use]
    pub fn of(strategy: &str) -> Option<(usize, &'static Self)> {
        let (name, threshold) = split_strategy(strategy);
        TABLE_2.iter().enumerate().find(|(_, row)| {
            row.strategy == name && (row.threshold.is_none() || row.threshold == threshold)
        })
    }

    /// Returns the measures for `task`.
    #[must_use]
    pub const fn measures(&self, task: Task) -> &PaperMeasures {
        if task.grasps() { &self.pick_and_place } else { &self.push }
    }
}

/// Splits a strategy into name and threshold. The default threshold is 0.1.
pub(crate) fn split_strategy(strategy: &str) -> (&str, Option<f64>) {
    match strategy.split_once(':') {
        Some((name, threshold)) => (name, threshold.parse().ok()),
        None => {
            let usual = match strategy {
                "none" | "ea" => None,
                "jsrl" => Some(20.0),
                _ => Some(0.1),
            };
            (strategy, usual)
        }
    }
}

/// Creates a row in which the paper gives all values, in its order: IE, RT, MSR, ELR.
const fn row(
    name: &'static str,
    strategy: &'static str,
    threshold: Option<f64>,
    push: [f64; 4],
    pick_and_place: [f64; 4],
) -> PaperRow {
    let ([a, b, c, d], [e, f, g, h]) = (push, pick_and_place);
    PaperRow {
        name,
        strategy,
        threshold,
        push: measures(a, b, c, d),
        pick_and_place: measures(e, f, g, h),
    }
}

const fn measures(
    inspired_epoch: f64,
    rising_epochs: f64,
    max_success: f64,
    learning_rate: f64,
) -> PaperMeasures {
    PaperMeasures {
        inspired_epoch: Some(inspired_epoch),
        rising_epochs: Some(rising_epochs),
        max_success,
        learning_rate,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_strategy_has_its_row() {
        let name = |strategy: &str| PaperRow::of(strategy).map(|(_, row)| row.name);
        assert_eq!(
            ["none", "ea", "eamc:0.1", "mc-q:0.05", "mc-q", "mc-q:0.10", "mc-act-abs:0.01"]
                .map(name),
            ["NA", "EA", "EAMC", "MC-Q005", "MC-Q01", "MC-Q01", "MC-ACTABS001"].map(Some)
        );
        assert_eq!(["mc-q:0.2", "other", ""].map(name), [None, None, None]);
    }

    #[test]
    fn effective_learning_rates_agree_with_the_other_columns() {
        let mut deviations = Vec::new();
        for (row, task) in TABLE_2.iter().flat_map(|row| Task::CLASSIC.map(|task| (row, task))) {
            let given = row.measures(task);
            let epochs = given.inspired_epoch.zip(given.rising_epochs).map(|(ie, rt)| ie + rt);
            let rate = epochs.map_or(0.0, |epochs| 0.9 * given.max_success / epochs);
            if (rate - given.learning_rate).abs() > 0.000_06 {
                deviations.push((row.name, task, given.learning_rate, rate));
            }
        }
        assert!(deviations.is_empty(), "{deviations:?}");
    }
}
