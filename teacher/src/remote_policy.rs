//! A policy in another process, behind `tandem.v1.Policy`.
//!
//! A task on the service's runtime owns the connection, and the thread of the advisor waits for its answers for up to
//! 3 s. Until the policy has answered, nothing is charged, so a student that repeats its request gets the same decision
//! as if the policy had never been away.

use std::time::Duration;

use tandem_core::TaskSpec;
use tandem_net::{AuthChannel, Backoff, ClientConfig, ClientConfigError, MAX_MESSAGE_BYTES};
use tandem_net::{Operation, Retrier, Retryability, retry, within};
use tandem_proto::pb::policy_client::PolicyClient;
use tandem_proto::{
    DecodeError, MAX_POLICY_STATES, PolicyAnswers, PolicyDescription, decode_policy_answers,
    decode_policy_description, encode_policy_request, pb,
};
use tokio::sync::{mpsc, oneshot};
use tonic::{Code, Status};

use crate::batch::Batch;

const BACKOFF: Backoff =
    Backoff { first_pause: Duration::from_millis(50), max_pause: Duration::from_millis(500) };
const DESCRIBE: Operation = Operation { peer: "policy", purpose: "ask for the policy" };
const EVALUATE: Operation = Operation { peer: "policy", purpose: "evaluate the policy" };

/// The time limits of a policy in another process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PolicyTimeouts {
    /// The time that a teacher waits at its start for the server of its policy.
    pub connect: Duration,
    /// The deadline of one call.
    pub call: Duration,
    /// The time within which 256 states must be evaluated, including repeated calls. It is shorter than the time limit
    /// of the teacher's own answers.
    pub answer: Duration,
}

impl Default for PolicyTimeouts {
    fn default() -> Self {
        Self {
            connect: Duration::from_secs(30),
            call: Duration::from_secs(2),
            answer: Duration::from_secs(3),
        }
    }
}

/// The reason why a policy in another process cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RemoteError {
    /// The address cannot be called.
    #[error("{0}")]
    Address(String),
    /// The server did not answer in time. Asking again may help.
    #[error("the policy at {address} does not answer: {reason}")]
    Unavailable {
        /// The address.
        address: String,
        /// The failure of the last call.
        reason: String,
    },
    /// The server has another policy than at the start of the teacher.
    #[error(
        "the policy at {address} has changed ({reason}): serve the earlier one again, or restart the teacher"
    )]
    Changed {
        /// The address.
        address: String,
        /// The message of the server.
        reason: String,
    },
    /// The server is not one of a usable policy, or refuses the call.
    #[error("the policy at {address} cannot be used: {reason}")]
    Refused {
        /// The address.
        address: String,
        /// The message of the server.
        reason: String,
    },
    /// The policy failed, or its answer is invalid.
    #[error("the policy at {address} failed: {reason}")]
    Failed {
        /// The address.
        address: String,
        /// The message of the server, or the invalid field.
        reason: String,
    },
}

/// The states of a call with the student's actions, and the receiver of the answers.
struct Job {
    n_states: usize,
    request: pb::EvaluatePolicyRequest,
    reply: oneshot::Sender<Result<PolicyAnswers, RemoteError>>,
}

/// A policy in another process.
pub struct RemotePolicy {
    address: String,
    description: PolicyDescription,
    jobs: mpsc::Sender<Job>,
}

impl RemotePolicy {
    /// Connects to the policy at `address`, and waits for its server if it is away.
    ///
    /// The connection belongs to the runtime of the caller; evaluations block a thread outside of it.
    ///
    /// # Errors
    /// When the address is invalid, nothing answers, or the policy is not for one arm of a known task.
    pub async fn connect(
        address: &str,
        config: &ClientConfig,
        timeouts: PolicyTimeouts,
    ) -> Result<Self, RemoteError> {
        let channel = config.channel(address).map_err(|error| unusable_address(&error))?;
        let client = PolicyClient::new(channel)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        let description = describe(&client, address, timeouts).await?;
        let (name, digest) = (&description.name, &description.digest);
        let has_values = description.has_values;
        tracing::info!(address, name, digest, has_values, "policy connected");
        let (jobs, queue) = mpsc::channel(1);
        let connection = Connection {
            client,
            address: address.to_owned(),
            description: description.clone(),
            timeouts,
        };
        tokio::spawn(connection.run(queue));
        Ok(Self { address: address.to_owned(), description, jobs })
    }

    /// Evaluates up to [`MAX_POLICY_STATES`] states, and blocks until the answer arrives.
    fn call(
        &self,
        request: pb::EvaluatePolicyRequest,
        n_states: usize,
    ) -> Result<PolicyAnswers, RemoteError> {
        let (reply, answer) = oneshot::channel();
        let gone = || RemoteError::Unavailable {
            address: self.address.clone(),
            reason: "the teacher is shutting down".to_owned(),
        };
        self.jobs.blocking_send(Job { n_states, request, reply }).map_err(|_closed| gone())?;
        answer.blocking_recv().map_err(|_closed| gone())?
    }
}

impl RemotePolicy {
    /// Returns the task, of one arm.
    #[must_use]
    pub const fn task(&self) -> &TaskSpec {
        &self.description.task
    }

    /// Returns the text that identifies the policy.
    #[must_use]
    pub fn digest(&self) -> &str {
        &self.description.digest
    }

    /// Returns true if the policy values actions.
    #[must_use]
    pub const fn has_values(&self) -> bool {
        self.description.has_values
    }

    /// Fills in the answers of `batch`, and blocks until they arrive.
    pub(crate) fn evaluate(&mut self, batch: &mut Batch) -> Result<(), RemoteError> {
        let task = &self.description.task;
        let mut answers = PolicyAnswers {
            actions: Vec::with_capacity(2 * batch.student_actions.len()),
            values: Vec::with_capacity(2 * batch.n_rows),
            proposed_values: Vec::with_capacity(batch.n_rows),
        };
        for start in (0..batch.n_rows).step_by(MAX_POLICY_STATES) {
            let rows = start..batch.n_rows.min(start + MAX_POLICY_STATES);
            let of = |length: usize| rows.start * length..rows.end * length;
            let request = encode_policy_request(
                &self.description.digest,
                &batch.observations[of(task.n_observation())],
                &batch.goals[of(task.n_goal())],
                &batch.student_actions[of(task.n_action())],
            );
            let mut part = self.call(request, rows.len())?;
            answers.actions.append(&mut part.actions);
            answers.values.append(&mut part.values);
            answers.proposed_values.append(&mut part.proposed_values);
        }
        batch.actions = answers.actions;
        batch.actions.extend_from_slice(&batch.student_actions);
        batch.q = answers.values;
        batch.q.append(&mut answers.proposed_values);
        batch.q.resize(2 * batch.n_rows, 0.0);
        Ok(())
    }
}

/// The connection to the server of a policy.
struct Connection {
    client: PolicyClient<AuthChannel>,
    address: String,
    description: PolicyDescription,
    timeouts: PolicyTimeouts,
}

impl Connection {
    /// Answers jobs until the policy is dropped.
    async fn run(self, mut jobs: mpsc::Receiver<Job>) {
        let mut retrier = Retrier::new(BACKOFF, EVALUATE);
        while let Some(job) = jobs.recv().await {
            let answers = self.evaluate(&job, &mut retrier).await;
            // A teacher that is shutting down waits for no answer.
            drop(job.reply.send(answers));
        }
    }

    async fn evaluate(
        &self,
        job: &Job,
        retrier: &mut Retrier,
    ) -> Result<PolicyAnswers, RemoteError> {
        let mut last = None;
        let attempts = async {
            loop {
                let mut client = self.client.clone();
                let call = async { client.evaluate(job.request.clone()).await };
                let outcome = within(self.timeouts.call, call).await;
                last = outcome.as_ref().err().cloned();
                // A policy that raised an exception would raise it again.
                if last.as_ref().is_some_and(|status| status.code() == Code::Internal) {
                    return outcome;
                }
                if let Some(outcome) = retrier.settle(outcome).await {
                    return outcome;
                }
            }
        };
        let outcome = tokio::time::timeout(self.timeouts.answer, attempts).await;
        let late =
            || Status::deadline_exceeded(format!("no answer within {:?}", self.timeouts.answer));
        let outcome = outcome.unwrap_or_else(|_elapsed| Err(last.unwrap_or_else(late)));
        let response = outcome.map_err(|status| self.failed(&status))?.into_inner();
        decode_policy_answers(&response, job.n_states, &self.description)
            .map_err(|error| self.invalid(&error))
    }

    fn failed(&self, status: &Status) -> RemoteError {
        let (address, reason) = (self.address.clone(), self.reason(status));
        match status.code() {
            Code::FailedPrecondition => RemoteError::Changed { address, reason },
            Code::Internal => RemoteError::Failed { address, reason },
            code if Retryability::of(code) == Retryability::Transient => {
                RemoteError::Unavailable { address, reason }
            }
            _ => RemoteError::Refused { address, reason },
        }
    }

    /// Returns the message of a failure without the part that [`RemoteError::Unavailable`] repeats.
    fn reason(&self, status: &Status) -> String {
        let message = status.message();
        let of_address = message.strip_prefix(&self.address);
        let reason = of_address.and_then(|rest| rest.strip_prefix(" does not answer: "));
        reason.unwrap_or(message).to_owned()
    }

    fn invalid(&self, error: &DecodeError) -> RemoteError {
        let reason = format!("it answered {error}");
        RemoteError::Failed { address: self.address.clone(), reason }
    }
}

/// Asks for the description of the policy.
async fn describe(
    client: &PolicyClient<AuthChannel>,
    address: &str,
    timeouts: PolicyTimeouts,
) -> Result<PolicyDescription, RemoteError> {
    let attempts = retry(BACKOFF, timeouts.call, DESCRIBE, || {
        let mut client = client.clone();
        async move { client.describe(pb::DescribePolicyRequest {}).await }
    });
    let unavailable = |_elapsed| RemoteError::Unavailable {
        address: address.to_owned(),
        reason: format!("no answer within {:?}", timeouts.connect),
    };
    let outcome = tokio::time::timeout(timeouts.connect, attempts).await.map_err(unavailable)?;
    let refused = |reason: String| RemoteError::Refused { address: address.to_owned(), reason };
    let message = outcome.map_err(|status| refused(status.message().to_owned()))?.into_inner();
    decode_policy_description(message).map_err(|error| refused(error.to_string()))
}

fn unusable_address(error: &ClientConfigError) -> RemoteError {
    RemoteError::Address(tandem_core::text::error_chain(error))
}

#[cfg(test)]
mod tests;
