//! Metrics of a run as a TensorBoard event file.
//!
//! The file is derived from the rows of `metrics.jsonl` and the time at which the run started, so [`write_events`] can
//! compare it with them and replace what differs: a run that is resumed has each evaluation once.
//!
//! The horizontal axis is the number of environment steps. The wall time of an event is the start of the run plus the
//! time for which the run has trained, without the pauses between its parts.

use std::fs::{File, OpenOptions};
use std::io::{Seek as _, SeekFrom, Write as _};
use std::path::Path;

use prost::Message;
use tandem_system::regular_file;

use crate::error::Error;
use crate::metrics::MetricsRow;

/// The path of the file in a run directory. TensorBoard expects one file of a writer in a directory.
pub const PATH: &str = "tensorboard/events.out.tfevents.0000000000.tandem";

/// The version of the format, in the first event of a file.
const VERSION: &str = "brain.Event:2";
/// The length of a record without its data: the data's length and two checksums, bytes.
const FRAME_BYTES: usize = 16;
/// Added to a rotated checksum, so that data that contains checksums can be checksummed again.
const MASK: u32 = 0xa282_ead8;

/// `tensorflow.Event`, as far as it is used.
#[derive(Clone, PartialEq, Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

/// `tensorflow.Summary`.
#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

/// `tensorflow.Summary.Value`, as far as it is used.
#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

/// Makes the event file at `path` one of exactly `rows`, and creates it if there is none.
///
/// Events that agree with `rows` are left as they are. `started_s` is the start of the run, seconds since 1970, for a
/// new file; an existing file keeps its own.
///
/// # Errors
/// If the file cannot be read or written. It is valid up to the first row that could not be written, and the next call
/// repairs it.
pub fn write_events(path: &Path, rows: &[MetricsRow], started_s: f64) -> Result<(), Error> {
    let mut file =
        OpenOptions::new().append(true).create(true).open(path).map_err(Error::io("open", path))?;
    let written = regular_file::read(path).map_err(Error::io("read", path))?;
    let started_s = start_of(&written).unwrap_or(started_s);
    let mut end = 0;
    let mut missing = Vec::new();
    for event in events(rows, started_s) {
        let record = encode_record(&event);
        if missing.is_empty() && written[end..].starts_with(&record) {
            end += record.len();
        } else {
            missing.extend(record);
        }
    }
    append_at(&mut file, end, written.len(), &missing).map_err(Error::io("write", path))
}

/// Replaces the bytes of `file` from `end` on by `bytes`, if that changes anything.
fn append_at(file: &mut File, end: usize, len: usize, bytes: &[u8]) -> std::io::Result<()> {
    if end < len {
        file.set_len(end as u64)?;
    }
    if bytes.is_empty() {
        return Ok(());
    }
    file.seek(SeekFrom::End(0))?;
    file.write_all(bytes)?;
    file.sync_data()
}

/// Returns the start of the run in the first event of a file; `None` if the file does not begin with a valid one.
fn start_of(bytes: &[u8]) -> Option<f64> {
    let length: [u8; 8] = bytes.get(..8)?.try_into().ok()?;
    let n_bytes = usize::try_from(u64::from_le_bytes(length)).ok()?;
    let data = bytes.get(12..)?.get(..n_bytes)?;
    let event = Event::decode(data).ok()?;
    let is_first = event.file_version.as_deref() == Some(VERSION);
    (is_first && bytes.starts_with(&encode_record(&event))).then_some(event.wall_time)
}

/// Returns the events of a file: its version, and one event for each row.
fn events(rows: &[MetricsRow], started_s: f64) -> impl Iterator<Item = Event> {
    let version =
        Event { wall_time: started_s, file_version: Some(VERSION.to_owned()), ..Event::default() };
    let event = move |row: &MetricsRow| Event {
        wall_time: started_s + row.wall_s,
        step: i64::try_from(row.env_steps).unwrap_or(i64::MAX),
        file_version: None,
        summary: Some(Summary { value: values(row) }),
    };
    std::iter::once(version).chain(rows.iter().map(event))
}

/// Returns the values of a row that exist, in a fixed order.
#[expect(clippy::cast_possible_truncation, reason = "TensorBoard's scalars have 32 bits")]
fn values(row: &MetricsRow) -> Vec<Value> {
    let contacts = &row.contacts;
    // The row of the initial policy has zeros for what has not been measured yet.
    let trained = |value: f64| (row.episodes > 0).then_some(value);
    let learned = |value: f64| (row.updates > 0).then_some(value);
    let known = [
        ("evaluation/success", Some(row.success)),
        ("evaluation/success_low", Some(row.success_low)),
        ("evaluation/success_high", Some(row.success_high)),
        ("evaluation/success_joint", Some(row.success_joint)),
        ("evaluation/success_without_contact", contacts.success_without_contact),
        ("evaluation/success_without_contact_low", contacts.success_without_contact_low),
        ("evaluation/success_without_contact_high", contacts.success_without_contact_high),
        ("evaluation/collision_rate", Some(row.collision_rate)),
        ("evaluation/collision_rate_before_success", Some(row.collision_rate_before_success)),
        ("evaluation/arm_contact_rate", contacts.arm_contact_rate),
        ("evaluation/table_contact_rate", contacts.table_contact_rate),
        ("evaluation/avoidance_rate", contacts.avoidance_rate),
        ("evaluation/moved", Some(row.moved)),
        ("evaluation/return", Some(row.mean_return)),
        ("training/success", trained(row.training_success)),
        ("training/moved", trained(row.training_moved)),
        ("q/mean", learned(row.mean_q)),
        ("loss/critic", learned(row.critic_loss)),
        ("loss/actor", learned(row.actor_loss)),
        ("advice/spent", Some(row.advice_spent as f64)),
        ("advice/queries", row.advice_queries.map(|queries| queries as f64)),
        ("advice/left", Some(row.budget_left as f64)),
        ("progress/round", Some(row.round as f64)),
        ("progress/episodes", Some(row.episodes as f64)),
        ("progress/updates", Some(row.updates as f64)),
        ("progress/wall_seconds", Some(row.wall_s)),
    ];
    let known = known.into_iter().map(|(tag, value)| (tag.to_owned(), value));
    let arms = row.success_per_arm.iter().enumerate();
    let arms = arms.map(|(arm, success)| (format!("evaluation/success_arm_{arm}"), Some(*success)));
    let numbers = known.chain(arms).filter_map(|(tag, value)| Some((tag, value?)));
    numbers
        .filter(|(_, value)| !value.is_nan())
        .map(|(tag, value)| Value { tag, simple_value: Some(value as f32) })
        .collect()
}

/// Encodes an event as a record: length, its checksum, data and its checksum.
fn encode_record(event: &Event) -> Vec<u8> {
    let data = event.encode_to_vec();
    let length = (data.len() as u64).to_le_bytes();
    let mut record = Vec::with_capacity(FRAME_BYTES + data.len());
    record.extend(length);
    record.extend(masked_checksum(&length).to_le_bytes());
    record.extend(&data);
    record.extend(masked_checksum(&data).to_le_bytes());
    record
}

/// Returns the CRC-32C of `bytes`, rotated and offset.
fn masked_checksum(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(MASK)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(rounds: &[u64]) -> Vec<MetricsRow> {
        let row = |round: &u64| MetricsRow {
            round: *round,
            env_steps: round * 1600,
            wall_s: *round as f64 * 2.5,
            success: *round as f64 / 100.0,
            success_per_arm: vec![0.5, 0.75],
            episodes: round * 32,
            updates: round * 40,
            mean_q: f64::NAN,
            ..MetricsRow::default()
        };
        rounds.iter().map(row).collect()
    }

    /// Decodes a file and checks every checksum.
    fn read(path: &Path) -> Vec<Event> {
        let bytes = std::fs::read(path).unwrap();
        let (mut rest, mut events) = (bytes.as_slice(), Vec::new());
        while !rest.is_empty() {
            let n_bytes = usize::try_from(u64::from_le_bytes(rest[..8].try_into().unwrap()));
            let event = Event::decode(&rest[12..12 + n_bytes.unwrap()]).unwrap();
            let record = encode_record(&event);
            assert!(rest.starts_with(&record), "checksums");
            rest = &rest[record.len()..];
            events.push(event);
        }
        events
    }

    fn steps(path: &Path) -> Vec<i64> {
        read(path).iter().map(|event| event.step).collect()
    }

    #[test]
    fn checksums_are_those_of_tensorflow() {
        // The first record of a file that TensorFlow's writer made at time 0.
        let version = Event { file_version: Some(VERSION.to_owned()), ..Event::default() };
        assert_eq!(crc32c::crc32c(b"123456789"), 0xe306_9283, "the check value of CRC-32C");
        let record = encode_record(&version);
        assert_eq!(&record[..8], &15_u64.to_le_bytes());
        assert_eq!(&record[8..12], &0x092b_536d_u32.to_le_bytes(), "of the length");
        assert_eq!(&record[12..27], b"\x1a\x0dbrain.Event:2");
        assert_eq!(&record[27..], &0x2951_98fc_u32.to_le_bytes(), "of the event");
    }

    #[test]
    fn an_event_has_the_values_of_its_row_that_exist() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("events");
        write_events(&path, &rows(&[10]), 1e9).unwrap();
        let events = read(&path);
        assert_eq!(events[0].file_version.as_deref(), Some(VERSION));
        assert_eq!((events[1].step, events[1].wall_time), (16_000, 1e9 + 25.0));
        let values = &events[1].summary.as_ref().unwrap().value;
        let value = |tag: &str| {
            let found = values.iter().find(|value| value.tag == tag);
            found.and_then(|value| value.simple_value)
        };
        assert_eq!(value("evaluation/success"), Some(0.1));
        assert_eq!(value("evaluation/success_arm_1"), Some(0.75));
        assert_eq!(value("q/mean"), None, "not a number");
        assert_eq!(value("evaluation/arm_contact_rate"), None, "not known");
        assert_eq!(value("loss/critic"), Some(0.0));
        assert_eq!(value("training/success"), Some(0.0));
    }

    #[test]
    fn the_initial_policy_has_no_values_of_training() {
        let tags: Vec<String> = values(&rows(&[0])[0]).into_iter().map(|it| it.tag).collect();
        assert!(tags.contains(&"evaluation/success".to_owned()), "{tags:?}");
        let is_measured =
            |tag: &String| ["training/", "q/", "loss/"].iter().any(|of| tag.starts_with(of));
        assert!(!tags.iter().any(is_measured), "{tags:?}");
    }

    #[test]
    fn a_file_of_another_state_is_repaired_and_keeps_its_start() {
        let check = |alter: fn(&mut Vec<u8>), known: &[u64], expected_start_s: f64| {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join("events");
            write_events(&path, &rows(&[5, 10, 15]), 1e9).unwrap();
            let mut bytes = std::fs::read(&path).unwrap();
            alter(&mut bytes);
            std::fs::write(&path, bytes).unwrap();
            write_events(&path, &rows(known), 2e9).unwrap();
            let expected: Vec<i64> = std::iter::once(0)
                .chain(known.iter().map(|round| round.cast_signed() * 1600))
                .collect();
            assert_eq!(steps(&path), expected);
            assert_eq!(read(&path)[0].wall_time.to_bits(), expected_start_s.to_bits());
        };
        check(|_| (), &[5, 10, 15], 1e9);
        check(|_| (), &[5, 10, 15, 20], 1e9);
        check(|_| (), &[5], 1e9);
        check(|_| (), &[], 1e9);
        check(|_| (), &[5, 11, 12], 1e9);
        check(|bytes| bytes.truncate(bytes.len() - 1), &[5, 10, 15], 1e9);
        check(|bytes| bytes.extend([7; 9]), &[5, 10, 15], 1e9);
        check(|bytes| bytes.fill(0), &[5, 10], 2e9);
        check(|bytes| bytes.truncate(11), &[5, 10], 2e9);
    }
}
