//! A server of a one-arm policy that moves toward its goal.

use std::sync::{Arc, Mutex, MutexGuard};

use tandem_core::TaskSpec;
use tandem_proto::pb;
use tandem_proto::pb::policy_server::{Policy, PolicyServer as Served};
use tonic::{Request, Response, Status};

use crate::reach::{Serving, serve};

/// What the server says about its policy.
#[derive(Debug)]
struct Description {
    task: TaskSpec,
    digest: String,
}

/// A server in this process, which ends when this value is dropped.
pub(crate) struct PolicyServer {
    pub(crate) address: String,
    description: Arc<Mutex<Description>>,
    _serving: Serving,
}

impl PolicyServer {
    pub(crate) fn start(task: TaskSpec) -> Self {
        let description = Description { task, digest: "seeker-1".to_owned() };
        let description = Arc::new(Mutex::new(description));
        let service = Served::new(Service { description: description.clone() });
        let serving = serve(|router| router.add_service(service));
        Self { address: serving.address.clone(), description, _serving: serving }
    }

    pub(crate) fn set_digest(&self, digest: &str) {
        digest.clone_into(&mut self.description().digest);
    }

    pub(crate) fn set_task(&self, task: TaskSpec) {
        self.description().task = task;
    }

    fn description(&self) -> MutexGuard<'_, Description> {
        self.description.lock().expect("no thread panics")
    }
}

struct Service {
    description: Arc<Mutex<Description>>,
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|word| f32::from_le_bytes(*word)).collect()
}

fn bytes(floats: impl IntoIterator<Item = f32>) -> Vec<u8> {
    floats.into_iter().flat_map(f32::to_le_bytes).collect()
}

#[tonic::async_trait]
impl Policy for Service {
    async fn describe(
        &self,
        _: Request<pb::DescribePolicyRequest>,
    ) -> Result<Response<pb::PolicyDescription>, Status> {
        let description = self.description.lock().expect("no thread panics");
        Ok(Response::new(pb::PolicyDescription {
            task: Some(tandem_proto::encode_task(&description.task)),
            name: "seeker".to_owned(),
            digest: description.digest.clone(),
            has_values: true,
        }))
    }

    async fn evaluate(
        &self,
        request: Request<pb::EvaluatePolicyRequest>,
    ) -> Result<Response<pb::EvaluatePolicyResponse>, Status> {
        let request = request.into_inner();
        let (positions, goals) = (floats(&request.observations), floats(&request.goals));
        let action = |(position, goal): (&f32, &f32)| (5.0 * (goal - position)).clamp(-1.0, 1.0);
        let actions: Vec<f32> = positions.iter().zip(&goals).map(action).collect();
        // The value of an action is minus its distance from the policy's own.
        let value = |(proposed, own): (&[f32], &[f32])| {
            proposed.iter().zip(own).map(|(proposed, own)| -(proposed - own).abs()).sum::<f32>()
        };
        let proposed = floats(&request.actions);
        let proposed_values =
            proposed.chunks_exact(2).zip(actions.chunks_exact(2)).map(value).collect::<Vec<_>>();
        let n_states = actions.len() / 2;
        Ok(Response::new(pb::EvaluatePolicyResponse {
            actions: bytes(actions),
            values: bytes(std::iter::repeat_n(0.0, n_states)),
            proposed_values: bytes(proposed_values),
        }))
    }
}
