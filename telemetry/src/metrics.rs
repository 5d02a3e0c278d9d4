//! Metrics of a run: `metrics.jsonl`, one JSON object per evaluation.

use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Deserializer, Serialize};
use tandem_core::{EvaluationSummary, Wilson};
use tandem_system::regular_file;

use crate::error::Error;

/// Metrics after one evaluation.
///
/// Shares are in [0, 1]. Before the first round, losses and values of training are 0. NaN is `null` in the file.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MetricsRow {
    /// Round after which the policy was evaluated.
    pub round: u64,
    /// Environment steps of training so far.
    pub env_steps: u64,
    /// Training episodes so far.
    pub episodes: u64,
    /// Updates of the networks so far.
    pub updates: u64,
    /// The paper's epochs so far, each of as many rounds as the setting `rounds.per_epoch` says, by default 50.
    pub paper_epochs: f64,
    /// Wall time of the run, seconds, summed over resumed parts.
    pub wall_s: f64,
    /// Success rate: share of evaluation episodes that end with every object at its goal.
    pub success: f64,
    /// Share of evaluation episodes that end with the joint norm within the tolerance.
    pub success_joint: f64,
    /// Success rate of each arm, shape `[n_arms]`.
    pub success_per_arm: Vec<f64>,
    /// Lower bound of the 95 % interval of `success`.
    pub success_low: f64,
    /// Upper bound of the 95 % interval of `success`.
    pub success_high: f64,
    /// Share of evaluation episodes with a contact between the arms, or between an arm and the table.
    pub collision_rate: f64,
    /// Q-value of the policy's actions, mean over the updates of the latest round.
    #[serde(deserialize_with = "nan_from_null")]
    pub mean_q: f64,
    /// Critic loss, mean over the updates of the latest round.
    #[serde(deserialize_with = "nan_from_null")]
    pub critic_loss: f64,
    /// Actor loss, mean over the updates of the latest round.
    #[serde(deserialize_with = "nan_from_null")]
    pub actor_loss: f64,
    /// Units of advice spent so far.
    pub advice_spent: u64,
    /// Units of advice left.
    pub budget_left: u64,
    /// Share of evaluation episodes in which an object was displaced.
    pub moved: f64,
    /// Share of evaluation episodes with such a contact before all objects were at their goals for good.
    pub collision_rate_before_success: f64,
    /// Success rate of the training episodes of the latest round.
    #[serde(deserialize_with = "nan_from_null")]
    pub training_success: f64,
    /// Share of the training episodes of the latest round in which an object was displaced.
    #[serde(deserialize_with = "nan_from_null")]
    pub training_moved: f64,
    /// Mean return of the evaluation episodes: the undiscounted sum of joint rewards.
    #[serde(deserialize_with = "nan_from_null")]
    pub mean_return: f64,
    /// Number of evaluation episodes.
    pub n_episodes: u64,
    /// `true` for the best policy so far.
    pub best: bool,
    /// Measures that distinguish contacts between arms from contacts with the table. A file of an earlier version does not
    /// have them.
    #[serde(flatten)]
    pub contacts: ContactMetrics,
    /// Training steps so far on which the teacher was asked. A file of an earlier version does not have them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub advice_queries: Option<u64>,
}

/// Measures of an evaluation that distinguish contacts between arms from contacts with the table. A value that is not
/// known is left out of the file.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ContactMetrics {
    /// Share of evaluation episodes that end with every object at its goal and have no contact between the arms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub success_without_contact: Option<f64>,
    /// Lower bound of the 95 % interval of `success_without_contact`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub success_without_contact_low: Option<f64>,
    /// Upper bound of the 95 % interval of `success_without_contact`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub success_without_contact_high: Option<f64>,
    /// Share of evaluation episodes with a contact between the arms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm_contact_rate: Option<f64>,
    /// Share of evaluation episodes with a contact between an arm and the table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub table_contact_rate: Option<f64>,
    /// Share of evaluation episodes in which the link avoidance limited the motion of an arm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub avoidance_rate: Option<f64>,
}

impl ContactMetrics {
    /// Returns the measures of `summary`.
    #[must_use]
    pub fn of(summary: &EvaluationSummary) -> Self {
        let success = summary.success_without_contact;
        let interval = success.map(|success| summary.interval_of(success));
        Self {
            success_without_contact: success,
            success_without_contact_low: interval.map(|interval| interval.low),
            success_without_contact_high: interval.map(|interval| interval.high),
            arm_contact_rate: summary.arm_contact_rate,
            table_contact_rate: summary.table_contact_rate,
            avoidance_rate: summary.avoidance_rate,
        }
    }

    /// Returns success without contact with its 95 % interval, if they are known.
    #[must_use]
    pub fn success(&self) -> Option<(f64, Wilson)> {
        let (low, high) = (self.success_without_contact_low?, self.success_without_contact_high?);
        Some((self.success_without_contact?, Wilson { low, high }))
    }
}

fn nan_from_null<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

/// A metrics file, open for appending.
#[derive(Debug)]
pub struct MetricsLog {
    path: PathBuf,
    file: File,
}

impl MetricsLog {
    /// Opens `path`, or creates it, and truncates it after the last line that agrees with `rows`.
    ///
    /// Returns the log and the number of rows that it contains, which are the first of `rows`.
    ///
    /// # Errors
    /// If the file cannot be opened, read or truncated.
    pub fn restore(path: &Path, rows: &[MetricsRow]) -> Result<(Self, usize), Error> {
        let file = OpenOptions::new()
            .append(true)
            .create(true)
            .open(path)
            .map_err(Error::io("open", path))?;
        let log = Self { path: path.to_owned(), file };
        let bytes = regular_file::read(path).map_err(Error::io("read", path))?;
        let (mut end, mut n_rows) = (0, 0);
        for row in rows {
            let line = encode_line(row).map_err(Error::io("compare", path))?;
            if !bytes[end..].starts_with(&line) {
                break;
            }
            end += line.len();
            n_rows += 1;
        }
        if end < bytes.len() {
            log.set_len(end)?;
        }
        Ok((log, n_rows))
    }

    /// Appends a row, as a whole or not at all.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn append(&mut self, row: &MetricsRow) -> Result<(), Error> {
        let write_error = |source| Error::io("append to", &self.path)(source);
        let line = encode_line(row).map_err(write_error)?;
        let end = self.file.metadata().map_err(write_error)?.len();
        let written = self.file.write_all(&line).and_then(|()| self.file.sync_data());
        written.map_err(|source| {
            // A full disk may accept part of a line, and still allows truncation.
            drop(self.file.set_len(end));
            write_error(source)
        })
    }

    /// Reads all rows of the metrics file `path`. An incomplete last line is ignored, with a warning.
    ///
    /// # Errors
    /// If the file cannot be read or a complete line is not a row.
    pub fn read_all(path: &Path) -> Result<Vec<MetricsRow>, Error> {
        let bytes = regular_file::read(path).map_err(Error::io("read", path))?;
        let mut rows = Vec::new();
        for (line_idx, line) in bytes.split_inclusive(|byte| *byte == b'\n').enumerate() {
            if !line.ends_with(b"\n") {
                tracing::warn!(?path, line = line_idx + 1, "incomplete metrics row ignored");
                break;
            }
            let row = serde_json::from_slice(line).map_err(|source| Error::MetricsRow {
                path: path.to_owned(),
                line: line_idx + 1,
                source,
            })?;
            rows.push(row);
        }
        Ok(rows)
    }

    fn set_len(&self, n_bytes: usize) -> Result<(), Error> {
        self.file.set_len(n_bytes as u64).map_err(Error::io("truncate", &self.path))
    }
}

/// Encodes a row as a line of the file.
fn encode_line(row: &MetricsRow) -> std::io::Result<Vec<u8>> {
    let mut line = serde_json::to_vec(row)?;
    line.push(b'\n');
    Ok(line)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(round: u64) -> MetricsRow {
        MetricsRow {
            round,
            success: 0.25,
            success_per_arm: vec![0.5, 0.75],
            critic_loss: 1.5,
            ..MetricsRow::default()
        }
    }

    fn rounds(path: &Path) -> Vec<u64> {
        MetricsLog::read_all(path).unwrap().iter().map(|row| row.round).collect()
    }

    fn log_of(rounds: &[u64]) -> (tempfile::TempDir, PathBuf, MetricsLog) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("metrics.jsonl");
        let (mut log, _) = MetricsLog::restore(&path, &[]).unwrap();
        rounds.iter().for_each(|round| log.append(&row(*round)).unwrap());
        (dir, path, log)
    }

    #[test]
    fn rows_are_read_as_they_were_written() {
        let (_dir, path, log) = log_of(&[5, 10]);
        drop(log);
        let (mut log, _) = MetricsLog::restore(&path, &[row(5), row(10)]).unwrap();
        log.append(&row(15)).unwrap();
        assert_eq!(MetricsLog::read_all(&path).unwrap(), [row(5), row(10), row(15)]);
    }

    #[test]
    fn a_missing_value_is_null_in_the_file_and_nan_when_read() {
        let (_dir, path, mut log) = log_of(&[]);
        log.append(&MetricsRow { mean_q: f64::NAN, ..row(5) }).unwrap();
        assert!(std::fs::read_to_string(&path).unwrap().contains(r#""mean_q":null"#));
        assert!(MetricsLog::read_all(&path).unwrap()[0].mean_q.is_nan());
    }

    #[test]
    fn a_row_of_an_earlier_version_has_no_contact_metrics_and_stays_as_it_is() {
        let (_dir, path, log) = log_of(&[5]);
        drop(log);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains("without_contact") && !text.contains("avoidance"), "{text}");
        let rows = MetricsLog::read_all(&path).unwrap();
        assert_eq!(rows[0].contacts, ContactMetrics::default());
        assert_eq!(rows[0].contacts.success(), None);
        assert_eq!(MetricsLog::restore(&path, &rows).unwrap().1, 1, "the line is kept");
    }

    #[test]
    fn known_contact_metrics_are_keys_of_the_row() {
        let contacts = ContactMetrics {
            success_without_contact: Some(0.5),
            arm_contact_rate: Some(0.0),
            ..ContactMetrics::default()
        };
        let (_dir, path, mut log) = log_of(&[]);
        log.append(&MetricsRow { contacts, ..row(5) }).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(r#""success_without_contact":0.5,"arm_contact_rate":0.0"#), "{text}");
        assert_eq!(MetricsLog::read_all(&path).unwrap()[0].contacts, contacts);
    }

    #[test]
    fn a_row_starts_with_the_documented_keys() {
        let text = serde_json::to_string(&row(5)).unwrap();
        let keys = "round env_steps episodes updates paper_epochs wall_s success success_joint success_per_arm success_low \
                    success_high collision_rate mean_q critic_loss actor_loss advice_spent budget_left";
        let positions: Vec<_> =
            keys.split_whitespace().map(|key| text.find(&format!("\"{key}\":")).unwrap()).collect();
        assert!(positions.is_sorted(), "{text}");
    }

    #[test]
    fn an_incomplete_last_line_is_removed_before_the_next_row() {
        let (_dir, path, _) = log_of(&[5, 10]);
        let complete = std::fs::read(&path).unwrap();
        let first = complete.iter().position(|byte| *byte == b'\n').unwrap() + 1;
        for n_bytes in [first + 1, first + 40, complete.len() - 1] {
            std::fs::write(&path, &complete[..n_bytes]).unwrap();
            assert_eq!(rounds(&path), [5]);
            let (mut log, _) = MetricsLog::restore(&path, &[row(5), row(10)]).unwrap();
            log.append(&row(20)).unwrap();
            assert_eq!(rounds(&path), [5, 20]);
        }
    }

    #[test]
    fn an_error_names_the_line_that_is_not_a_row() {
        let (_dir, path, _) = log_of(&[5]);
        OpenOptions::new().append(true).open(&path).unwrap().write_all(b"{\"round\":\n").unwrap();
        assert!(matches!(MetricsLog::read_all(&path), Err(Error::MetricsRow { line: 2, .. })));
    }

    #[test]
    fn restore_removes_what_differs_from_the_known_rows() {
        let check = |known: &[u64], alter: fn(&mut Vec<u8>), expected: &[u64]| {
            let (_dir, path, log) = log_of(&[5, 10, 15]);
            drop(log);
            let mut bytes = std::fs::read(&path).unwrap();
            alter(&mut bytes);
            std::fs::write(&path, bytes).unwrap();
            let known: Vec<MetricsRow> = known.iter().map(|round| row(*round)).collect();
            let (mut log, n_rows) = MetricsLog::restore(&path, &known).unwrap();
            assert_eq!(n_rows, expected.len());
            assert_eq!(rounds(&path), expected);
            log.append(&row(99)).unwrap();
            assert_eq!(rounds(&path), [expected, &[99]].concat());
        };
        check(&[5, 10, 15], |_| (), &[5, 10, 15]);
        check(&[5, 10, 15, 20], |_| (), &[5, 10, 15]);
        check(&[5, 10], |_| (), &[5, 10]);
        check(&[], |_| (), &[]);
        check(&[5, 11, 15], |_| (), &[5]);
        check(&[5, 10, 15], |bytes| bytes.truncate(bytes.len() - 1), &[5, 10]);
        check(&[5, 10, 15], |bytes| bytes.extend(b"{\"round\":"), &[5, 10, 15]);
        check(&[5, 10, 15], |bytes| bytes.fill(0), &[]);
    }

    #[test]
    fn a_number_has_the_same_bits_after_writing_and_reading() {
        // A parser that rounds twice reads a neighbour of the third number.
        for success in [0.1 + 0.2, 1.0 / 3.0, 1.234_567_890_123_456_7e-300, 5e-324] {
            let (_dir, path, mut log) = log_of(&[]);
            log.append(&MetricsRow { success, ..row(5) }).unwrap();
            assert_eq!(
                MetricsLog::read_all(&path).unwrap()[0].success.to_bits(),
                success.to_bits()
            );
        }
        let n_exact = (1..2000_u32).map(|n| f64::from(n) / 1999.0).filter(|x| {
            serde_json::from_str::<f64>(&x.to_string()).unwrap().to_bits() == x.to_bits()
        });
        assert_eq!(n_exact.count(), 1999);
    }
}
