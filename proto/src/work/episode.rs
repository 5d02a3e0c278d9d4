//! Conversions of episodes.

use tandem_core::{Contacts, Episode, TaskSpec};

use super::{decode_episode_kind, encode_episode_kind};
use crate::error::DecodeError;
use crate::numbers::{actions_from_bytes, bounded_from_bytes, count_within, to_bytes};
use crate::pb;

/// Encodes an episode.
#[must_use]
pub fn encode_episode(episode: &Episode) -> pb::Episode {
    pb::Episode {
        number: episode.number,
        kind: encode_episode_kind(episode.kind).into(),
        parameter_version: episode.parameter_version,
        observations: to_bytes(&episode.observations),
        goal: to_bytes(&episode.goal),
        actions: to_bytes(&episode.actions),
        advised_arms: episode.advised_arms.clone(),
        contacts: episode.contacts.iter().map(|contacts| contacts.bits()).collect(),
        advice_charged: episode.advice_charged,
        avoidance_steps: episode.avoidance_steps,
        queried_steps: episode.queried_steps,
    }
}

/// Decodes an episode of a run of `task`.
///
/// # Errors
/// Returns an error if the kind is unknown, a length does not match the task, a number is not finite or beyond its
/// bound (see [`tandem_core::bounds`]), an action is outside [−1, 1], an undefined bit of `advised_arms` or `contacts`
/// is set, or more units were charged, or avoidance steps or queries counted, than the episode has steps.
pub fn decode_episode(
    episode: pb::Episode,
    task: impl Into<TaskSpec>,
) -> Result<Episode, DecodeError> {
    let task = task.into();
    let n_steps = task.episode_steps();
    let n_observations = (n_steps + 1) * task.n_observation();
    let max_count = u32::try_from(n_steps).expect("an episode has few steps");
    let counted_steps = |field, count: Option<u32>| {
        count.map(|count| count_within(field, count, &(0..=max_count))).transpose()
    };
    let avoidance_steps = counted_steps("avoidance_steps", episode.avoidance_steps)?;
    let queried_steps = counted_steps("queried_steps", episode.queried_steps)?;
    Ok(Episode {
        number: episode.number,
        kind: decode_episode_kind(episode.kind)?,
        parameter_version: episode.parameter_version,
        observations: bounded_from_bytes(
            "observations",
            &episode.observations,
            n_observations,
            |idx| task.observation_bound(idx % task.n_observation()),
        )?,
        goal: bounded_from_bytes("goal", &episode.goal, task.n_goal(), |idx| task.goal_bound(idx))?,
        actions: actions_from_bytes("actions", &episode.actions, n_steps * task.n_action())?,
        advised_arms: decode_advised_arms(episode.advised_arms, &task)?,
        contacts: decode_contacts(&episode.contacts, n_steps)?,
        advice_charged: count_within("advice_charged", episode.advice_charged, &(0..=max_count))?,
        avoidance_steps,
        queried_steps,
        task,
    })
}

fn decode_advised_arms(advised_arms: Vec<u8>, task: &TaskSpec) -> Result<Vec<u8>, DecodeError> {
    check_one_per_step("advised_arms", &advised_arms, task.episode_steps())?;
    let names_an_arm = |bits: u8| (u32::from(bits) >> task.n_arms()) == 0;
    match advised_arms.iter().position(|bits| !names_an_arm(*bits)) {
        None => Ok(advised_arms),
        Some(step_idx) => {
            let expected = format_args!("bits of {} arms", task.n_arms()).to_string();
            let got = format_args!("{:#010b}", advised_arms[step_idx]).to_string();
            Err(DecodeError::new(format!("advised_arms[{step_idx}]"), expected, got))
        }
    }
}

fn decode_contacts(contacts: &[u8], n_steps: usize) -> Result<Vec<Contacts>, DecodeError> {
    check_one_per_step("contacts", contacts, n_steps)?;
    contacts.iter().enumerate().map(decode_contact).collect()
}

/// Decodes the byte at an index of `contacts`.
pub(crate) fn decode_contact((idx, bits): (usize, &u8)) -> Result<Contacts, DecodeError> {
    let unknown = || {
        let expected =
            "bits 0 (arm and arm), 1 (arm and table), and with it 2 and 3 (first, second arm)";
        let got = format_args!("{bits:#010b}").to_string();
        DecodeError::new(format!("contacts[{idx}]"), expected, got)
    };
    Contacts::from_bits(*bits).ok_or_else(unknown)
}

fn check_one_per_step(field: &str, bytes: &[u8], n_steps: usize) -> Result<(), DecodeError> {
    if bytes.len() == n_steps {
        return Ok(());
    }
    let expected = format_args!("{n_steps} bytes, one per step").to_string();
    Err(DecodeError::new(field, expected, format_args!("{} bytes", bytes.len())))
}

#[cfg(test)]
mod tests {
    use prost::Message as _;
    use tandem_core::layout::EPISODE_STEPS;
    use tandem_core::{EpisodeKind, Layout, Task};

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);

    fn episode() -> Episode {
        let ramp = |n: u16| (0..n).map(|i| f32::from(i) / 4096.0).collect();
        let contact_of =
            |step_idx: usize| if step_idx == 11 { Contacts::ARM_TABLE } else { Contacts::NONE };
        Episode {
            number: 7,
            kind: EpisodeKind::Training,
            parameter_version: 3,
            task: LAYOUT.into(),
            observations: ramp(51 * 56),
            goal: ramp(6),
            actions: ramp(50 * 6),
            advised_arms: (0..50).map(|step_idx| step_idx % 4).collect(),
            contacts: (0..EPISODE_STEPS).map(contact_of).collect(),
            advice_charged: 38,
            avoidance_steps: Some(2),
            queried_steps: Some(44),
        }
    }

    #[test]
    fn an_episode_round_trips() {
        let bytes = encode_episode(&episode()).encode_to_vec();
        let message = pb::Episode::decode(bytes.as_slice()).unwrap();
        assert_eq!(decode_episode(message, LAYOUT), Ok(episode()));
    }

    #[test]
    fn a_malformed_episode_is_refused_by_name() {
        let check = |corrupt: fn(&mut pb::Episode), message: &str| {
            let mut malformed = encode_episode(&episode());
            corrupt(&mut malformed);
            assert_eq!(decode_episode(malformed, LAYOUT).unwrap_err().to_string(), message);
        };
        check(|e| e.kind = -1, "kind: expected 1 (training) or 2 (evaluation), got -1");
        check(
            |e| e.observations.truncate(50 * 56 * 4),
            "observations: expected 2856 numbers, got 2800 numbers",
        );
        check(|e| e.goal.push(0), "goal: expected 24 bytes, 4 per number, got 25 bytes");
        check(
            |e| e.actions[4..8].copy_from_slice(&2.0_f32.to_le_bytes()),
            "actions[1]: expected a number in [-1, 1], got 2",
        );
        check(
            |e| e.advised_arms.truncate(49),
            "advised_arms: expected 50 bytes, one per step, got 49 bytes",
        );
        check(
            |e| e.advised_arms[2] = 4,
            "advised_arms[2]: expected bits of 2 arms, got 0b00000100",
        );
        check(
            |e| e.contacts[49] = 4,
            "contacts[49]: expected bits 0 (arm and arm), 1 (arm and table), and with it 2 and 3 (first, second arm), got 0b00000100",
        );
        check(
            |e| e.observations[400..404].copy_from_slice(&1e29_f32.to_le_bytes()),
            "observations[100]: expected a number in [-2, 2], got 1e29",
        );
        check(
            |e| e.goal[8..12].copy_from_slice(&(-3.5_f32).to_le_bytes()),
            "goal[2]: expected a number in [-2, 2], got -3.5e0",
        );
        check(|e| e.advice_charged = 51, "advice_charged: expected 0 to 50, got 51");
        check(|e| e.avoidance_steps = Some(51), "avoidance_steps: expected 0 to 50, got 51");
        check(|e| e.queried_steps = Some(51), "queried_steps: expected 0 to 50, got 51");
    }

    #[test]
    fn an_episode_of_another_task_is_refused() {
        assert!(
            decode_episode(encode_episode(&episode()), Layout::new(Task::PickAndPlace, 2)).is_err()
        );
        assert!(decode_episode(encode_episode(&episode()), Layout::new(Task::Push, 1)).is_err());
    }
}
