//! Conversions for `environment.proto`: episodes played in an environment of another process.

use tandem_core::work::EpisodeStart;
use tandem_core::{Contacts, EpisodeKind, TaskSpec, WorldSettings};

use crate::error::DecodeError;
use crate::numbers::{actions_from_bytes, count_within, floats_from_bytes, one_within, to_bytes};
use crate::pb;
use crate::task::{decode_task, encode_task};
use crate::work::{MAX_SLOT_EPISODES, MAX_SUBSTEPS, decode_contact};

/// Largest number of environments of a stream.
pub const MAX_ENVIRONMENTS: usize = MAX_SLOT_EPISODES;

/// The description of a server of environments.
#[derive(Debug, Clone, PartialEq)]
pub struct EnvironmentDescription {
    /// The task of the environments.
    pub task: TaskSpec,
    /// Name and version of the server's program, of any length.
    pub server: String,
    /// The largest number of environments of a stream.
    pub max_environments: usize,
}

/// A decoded request of a stream.
#[derive(Debug, Clone, PartialEq)]
pub enum PlayCommand {
    /// Starts an episode in each of these environments, in this order.
    Reset(Vec<(usize, EpisodeStart)>),
    /// Executes these actions, shape `[n, n_action]`.
    Step(Vec<f32>),
}

/// The environments at the start of their episodes.
#[derive(Debug, Clone, PartialEq)]
pub struct ResetReply {
    /// Observations, shape `[n, n_observation]`.
    pub observations: Vec<f32>,
    /// Goals, shape `[n, n_goal]`.
    pub goals: Vec<f32>,
}

/// The environments after a step.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReply {
    /// Observations, shape `[n, n_observation]`.
    pub observations: Vec<f32>,
    /// Contacts during the step, shape `[n]`.
    pub contacts: Vec<Contacts>,
}

/// Encodes the description of a server, called `server`, with environments of `task`.
#[must_use]
pub fn encode_environment(
    task: &TaskSpec,
    server: &str,
    max_environments: usize,
) -> pb::EnvironmentDescription {
    pb::EnvironmentDescription {
        task: Some(encode_task(task)),
        server: server.to_owned(),
        max_environments: u32::try_from(max_environments).unwrap_or(u32::MAX),
    }
}

/// Decodes the description of a server.
///
/// # Errors
/// Returns an error if the task is missing or invalid, or the number of environments is 0.
pub fn decode_environment(
    description: pb::EnvironmentDescription,
) -> Result<EnvironmentDescription, DecodeError> {
    let task = description.task.ok_or_else(|| DecodeError::missing("task"))?;
    let max = count_within("max_environments", description.max_environments, &(1..=u32::MAX))?;
    Ok(EnvironmentDescription {
        task: decode_task(task).map_err(|error| error.within("task"))?,
        server: description.server,
        max_environments: usize::try_from(max).unwrap_or(usize::MAX),
    })
}

/// Encodes a request that resets environments 0 to `starts.len() - 1`.
///
/// # Panics
/// If the number of environments exceeds `u32`.
#[must_use]
pub fn encode_reset(starts: &[EpisodeStart]) -> pb::PlayRequest {
    let environments = starts.iter().enumerate().map(|(idx, start)| pb::EnvironmentReset {
        environment: u32::try_from(idx).expect("a stream has few environments"),
        seed: start.seed,
        episode: start.number,
        evaluation: start.kind == EpisodeKind::Evaluation,
        grasped_start_prob: start.world.grasped_start_prob,
        substeps: start.world.substeps,
        randomization: start.world.randomization,
    });
    let reset = pb::ResetEnvironments { environments: environments.collect() };
    pb::PlayRequest { command: Some(pb::play_request::Command::Reset(reset)) }
}

/// Encodes a request that executes `actions`, shape `[n, n_action]`.
#[must_use]
pub fn encode_step(actions: &[f32]) -> pb::PlayRequest {
    let step = pb::StepEnvironments { actions: to_bytes(actions) };
    pb::PlayRequest { command: Some(pb::play_request::Command::Step(step)) }
}

/// Decodes a request of a stream with `n` environments; `n` is `None` before the first request.
///
/// # Errors
/// Returns an error if the first request is not a reset of environments 0 to n - 1, a later reset names an unknown
/// environment or one twice, a number is out of range, or the length of the actions does not match.
pub fn decode_play_request(
    request: pb::PlayRequest,
    n: Option<usize>,
    task: &TaskSpec,
) -> Result<PlayCommand, DecodeError> {
    use pb::play_request::Command;
    match (request.command, n) {
        (None, _) => Err(DecodeError::missing("command")),
        (Some(Command::Reset(reset)), _) => {
            decode_reset(reset, n).map(PlayCommand::Reset).map_err(|error| error.within("reset"))
        }
        (Some(Command::Step(_)), None) => {
            Err(DecodeError::new("command", "a reset as the first request", "a step"))
        }
        (Some(Command::Step(step)), Some(n)) => {
            let actions = actions_from_bytes("step.actions", &step.actions, n * task.n_action());
            actions.map(PlayCommand::Step)
        }
    }
}

fn decode_reset(
    reset: pb::ResetEnvironments,
    n: Option<usize>,
) -> Result<Vec<(usize, EpisodeStart)>, DecodeError> {
    let (n_reset, n_known) = (reset.environments.len(), n.unwrap_or(MAX_ENVIRONMENTS));
    if !(1..=n_known).contains(&n_reset) {
        let expected = format_args!("1 to {n_known} environments").to_string();
        return Err(DecodeError::new("environments", expected, n_reset));
    }
    let mut is_reset = vec![false; n.unwrap_or(n_reset)];
    let decode = |(position, reset): (usize, pb::EnvironmentReset)| {
        let within = |error: DecodeError| error.within(format_args!("environments[{position}]"));
        let idx = usize::try_from(reset.environment).unwrap_or(usize::MAX);
        let expected = match n {
            None if idx != position => position.to_string(),
            _ if is_reset.get(idx) == Some(&false) => String::new(),
            _ => format!("0 to {}, each once", is_reset.len() - 1),
        };
        if !expected.is_empty() {
            return Err(within(DecodeError::new("environment", expected, reset.environment)));
        }
        is_reset[idx] = true;
        Ok((idx, decode_start(&reset).map_err(within)?))
    };
    reset.environments.into_iter().enumerate().map(decode).collect()
}

fn decode_start(reset: &pb::EnvironmentReset) -> Result<EpisodeStart, DecodeError> {
    let prob = reset.grasped_start_prob;
    Ok(EpisodeStart {
        number: reset.episode,
        seed: reset.seed,
        kind: if reset.evaluation { EpisodeKind::Evaluation } else { EpisodeKind::Training },
        world: WorldSettings {
            grasped_start_prob: one_within("grasped_start_prob", prob, &(0.0..=1.0))?,
            grasped_start_env_steps: 0,
            substeps: match reset.substeps {
                0 => WorldSettings::default().substeps,
                substeps => count_within("substeps", substeps, &(1..=MAX_SUBSTEPS))?,
            },
            randomization: one_within("randomization", reset.randomization, &(0.0..=1.0))?,
        },
    })
}

/// Encodes the response to a reset. Shapes: `observations` `[m, n_observation]`, `goals` `[m, n_goal]`.
#[must_use]
pub fn encode_reset_reply(observations: &[f32], goals: &[f32]) -> pb::PlayResponse {
    pb::PlayResponse {
        observations: to_bytes(observations),
        goals: to_bytes(goals),
        contacts: Vec::new(),
    }
}

/// Encodes the response to a step. Shapes: `observations` `[n, n_observation]`, `contacts` `[n]`.
#[must_use]
pub fn encode_step_reply(observations: &[f32], contacts: &[Contacts]) -> pb::PlayResponse {
    pb::PlayResponse {
        observations: to_bytes(observations),
        goals: Vec::new(),
        contacts: contacts.iter().map(|contacts| contacts.bits()).collect(),
    }
}

/// Decodes the response to a reset of `n` environments.
///
/// # Errors
/// Returns an error if a length does not match, or a number is not finite or beyond its bound.
pub fn decode_reset_reply(
    reply: &pb::PlayResponse,
    n: usize,
    task: &TaskSpec,
) -> Result<ResetReply, DecodeError> {
    check_empty("contacts", &reply.contacts)?;
    Ok(ResetReply {
        observations: decode_observations(&reply.observations, n, task)?,
        goals: decode_rows("goals", &reply.goals, n, task.n_goal(), |idx| task.goal_bound(idx))?,
    })
}

/// Decodes the response to a step of `n` environments.
///
/// # Errors
/// Returns an error if a length does not match, a number is not finite or beyond its bound, or an undefined bit of
/// `contacts` is set.
pub fn decode_step_reply(
    reply: &pb::PlayResponse,
    n: usize,
    task: &TaskSpec,
) -> Result<StepReply, DecodeError> {
    check_empty("goals", &reply.goals)?;
    Ok(StepReply {
        observations: decode_observations(&reply.observations, n, task)?,
        contacts: decode_contacts(&reply.contacts, n, task)?,
    })
}

/// Decodes the contacts of `n` environments. A task may report none.
fn decode_contacts(bytes: &[u8], n: usize, task: &TaskSpec) -> Result<Vec<Contacts>, DecodeError> {
    if !task.reports_contacts() {
        check_empty("contacts", bytes)?;
        return Ok(vec![Contacts::NONE; n]);
    }
    if bytes.len() != n {
        let expected = format_args!("{n} bytes, one per environment").to_string();
        let got = format_args!("{} bytes", bytes.len()).to_string();
        return Err(DecodeError::new("contacts", expected, got));
    }
    bytes.iter().enumerate().map(decode_contact).collect()
}

fn decode_observations(bytes: &[u8], n: usize, task: &TaskSpec) -> Result<Vec<f32>, DecodeError> {
    let bound = |idx| task.observation_bound(idx);
    decode_rows("observations", bytes, n, task.n_observation(), bound)
}

/// Decodes `n` rows of `n_columns` finite numbers. `largest` returns the bound on the magnitude of a column.
fn decode_rows(
    field: &str,
    bytes: &[u8],
    n: usize,
    n_columns: usize,
    largest: impl Fn(usize) -> f32,
) -> Result<Vec<f32>, DecodeError> {
    let values = floats_from_bytes(field, bytes, n * n_columns)?;
    for (row_idx, row) in values.chunks_exact(n_columns).enumerate() {
        let is_invalid =
            |(idx, value): &(usize, &f32)| !value.is_finite() || value.abs() > largest(*idx);
        if let Some((idx, value)) = row.iter().enumerate().find(is_invalid) {
            let bound = largest(idx);
            let expected = format_args!("a number in [-{bound}, {bound}]").to_string();
            let field = format!("environment {row_idx}: {field}[{idx}]");
            return Err(DecodeError::new(field, expected, value));
        }
    }
    Ok(values)
}

fn check_empty(field: &str, bytes: &[u8]) -> Result<(), DecodeError> {
    if bytes.is_empty() {
        return Ok(());
    }
    Err(DecodeError::new(field, "no bytes", format_args!("{} bytes", bytes.len())))
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;
    use tandem_core::task::TaskDescription;

    use super::*;

    fn task() -> TaskSpec {
        TaskSpec::built_in(Task::Push, 1)
    }

    fn start(number: u64) -> EpisodeStart {
        EpisodeStart {
            number,
            seed: 7,
            kind: EpisodeKind::Training,
            world: WorldSettings {
                grasped_start_prob: 0.25,
                grasped_start_env_steps: 0,
                substeps: 10,
                randomization: 0.5,
            },
        }
    }

    fn reset(corrupt: impl FnOnce(&mut Vec<pb::EnvironmentReset>)) -> pb::PlayRequest {
        let mut request = encode_reset(&[start(3), start(4)]);
        let Some(pb::play_request::Command::Reset(reset)) = &mut request.command else {
            panic!("a reset")
        };
        corrupt(&mut reset.environments);
        request
    }

    #[test]
    fn requests_round_trip() {
        let decoded = decode_play_request(reset(|_| ()), None, &task());
        assert_eq!(decoded, Ok(PlayCommand::Reset(vec![(0, start(3)), (1, start(4))])));
        let actions = vec![0.5, -1.0, 0.0, 1.0, 0.25, -0.75];
        let decoded = decode_play_request(encode_step(&actions), Some(2), &task());
        assert_eq!(decoded, Ok(PlayCommand::Step(actions)));
    }

    #[test]
    fn a_later_reset_names_some_environments_in_any_order() {
        let last = reset(|resets| {
            resets.remove(0);
        });
        let decoded = decode_play_request(last, Some(2), &task());
        assert_eq!(decoded, Ok(PlayCommand::Reset(vec![(1, start(4))])));
        let decoded = decode_play_request(reset(|resets| resets.reverse()), Some(2), &task());
        assert_eq!(decoded, Ok(PlayCommand::Reset(vec![(1, start(4)), (0, start(3))])));
    }

    #[test]
    fn a_malformed_request_is_refused_by_name() {
        let check = |request: pb::PlayRequest, n, message: &str| {
            assert_eq!(decode_play_request(request, n, &task()).unwrap_err().to_string(), message);
        };
        check(pb::PlayRequest::default(), Some(2), "command: expected a message, got none");
        check(
            encode_step(&[0.0; 3]),
            None,
            "command: expected a reset as the first request, got a step",
        );
        check(
            reset(Vec::clear),
            None,
            "reset.environments: expected 1 to 1024 environments, got 0",
        );
        check(
            reset(|resets| resets.push(resets[0])),
            Some(2),
            "reset.environments: expected 1 to 2 environments, got 3",
        );
        check(
            reset(|resets| resets[0].environment = 1),
            None,
            "reset.environments[0].environment: expected 0, got 1",
        );
        check(
            reset(|resets| resets[1].environment = 0),
            Some(2),
            "reset.environments[1].environment: expected 0 to 1, each once, got 0",
        );
        check(
            reset(|resets| resets[1].environment = u32::MAX),
            Some(2),
            "reset.environments[1].environment: expected 0 to 1, each once, got 4294967295",
        );
        check(
            reset(|resets| resets[0].grasped_start_prob = f32::NAN),
            None,
            "reset.environments[0].grasped_start_prob: expected a number in [0, 1], got NaN",
        );
        check(
            reset(|resets| resets[1].substeps = 10_001),
            None,
            "reset.environments[1].substeps: expected 1 to 10000, got 10001",
        );
        check(encode_step(&[0.0; 5]), Some(2), "step.actions: expected 6 numbers, got 5 numbers");
        check(
            encode_step(&[0.0, 0.0, 0.0, 0.0, f32::NAN, 0.0]),
            Some(2),
            "step.actions[4]: expected a number in [-1, 1], got NaN",
        );
        check(
            encode_step(&[0.0, 1.5, 0.0]),
            Some(1),
            "step.actions[1]: expected a number in [-1, 1], got 1.5",
        );
    }

    #[test]
    fn a_description_round_trips_and_a_malformed_one_is_refused_by_name() {
        let message = encode_environment(&task(), "lab 2", 8);
        let description = EnvironmentDescription {
            task: task(),
            server: "lab 2".to_owned(),
            max_environments: 8,
        };
        assert_eq!(decode_environment(message.clone()), Ok(description));
        let check = |corrupt: fn(&mut pb::EnvironmentDescription), expected: &str| {
            let mut malformed = message.clone();
            corrupt(&mut malformed);
            assert_eq!(decode_environment(malformed).unwrap_err().to_string(), expected);
        };
        check(|it| it.task = None, "task: expected a message, got none");
        check(|it| it.max_environments = 0, "max_environments: expected 1 to 4294967295, got 0");
        check(|it| it.task.as_mut().unwrap().n_goal = 0, "task.n_goal: expected 1 to 4096, got 0");
    }

    #[test]
    fn responses_round_trip() {
        let ramp = |n: u16| (0..n).map(|i| f32::from(i) / 256.0).collect::<Vec<f32>>();
        let reply = ResetReply { observations: ramp(56), goals: ramp(6) };
        let message = encode_reset_reply(&reply.observations, &reply.goals);
        assert_eq!(decode_reset_reply(&message, 2, &task()), Ok(reply));
        let contacts = vec![Contacts::NONE, Contacts::ARM_TABLE];
        let reply = StepReply { observations: ramp(56), contacts };
        let message = encode_step_reply(&reply.observations, &reply.contacts);
        assert_eq!(decode_step_reply(&message, 2, &task()), Ok(reply));
    }

    #[test]
    fn a_malformed_response_is_refused_with_environment_field_and_value() {
        let check = |corrupt: fn(&mut pb::PlayResponse), message: &str| {
            let mut reply = encode_step_reply(&[0.0; 56], &[Contacts::NONE; 2]);
            corrupt(&mut reply);
            assert_eq!(decode_step_reply(&reply, 2, &task()).unwrap_err().to_string(), message);
        };
        check(
            |reply| reply.observations[4 * 33..4 * 34].fill(0xff),
            "environment 1: observations[5]: expected a number in [-25, 25], got NaN",
        );
        check(
            |reply| reply.observations[..4].copy_from_slice(&3.5_f32.to_le_bytes()),
            "environment 0: observations[0]: expected a number in [-2, 2], got 3.5",
        );
        check(
            |reply| reply.observations.truncate(4 * 28),
            "observations: expected 56 numbers, got 28 numbers",
        );
        check(
            |reply| reply.contacts.truncate(1),
            "contacts: expected 2 bytes, one per environment, got 1 bytes",
        );
        check(
            |reply| reply.contacts[1] = 4,
            "contacts[1]: expected bits 0 (arm and arm), 1 (arm and table), and with it 2 and 3 (first, second arm), got 0b00000100",
        );
        check(|reply| reply.goals = vec![0; 24], "goals: expected no bytes, got 24 bytes");
        let name = "silent".to_owned();
        let silent =
            TaskDescription { name, reports_contacts: false, ..task().description().clone() };
        let silent = TaskSpec::new(silent).unwrap();
        let reply = encode_step_reply(&[0.0; 28], &[Contacts::NONE]);
        let error = decode_step_reply(&reply, 1, &silent).unwrap_err().to_string();
        assert_eq!(error, "contacts: expected no bytes, got 1 bytes");
        let reply = encode_step_reply(&[0.0; 28], &[]);
        let decoded = decode_step_reply(&reply, 1, &silent).unwrap();
        assert_eq!(decoded.contacts, [Contacts::NONE]);
        let goals = encode_reset_reply(&[0.0; 28], &[0.0, f32::INFINITY, 0.0]);
        let error = decode_reset_reply(&goals, 1, &task()).unwrap_err().to_string();
        assert_eq!(error, "environment 0: goals[1]: expected a number in [-2, 2], got inf");
    }
}
