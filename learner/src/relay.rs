//! A relay: a learner to its workers, a client to the learner.
//!
//! Parameters are fetched once a version and handed out from here; everything else is passed on. So a learner with a
//! thousand workers behind ten relays sends ten copies of a version and not a thousand. A relay keeps nothing that a
//! run needs: one that dies is started again, and its workers ask again meanwhile.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tandem_net::{
    AuthChannel, ClientConfig, EncodedResponse, Incoming, MAX_MESSAGE_BYTES, ServerConfig, within,
};
use tandem_proto::pb;
use tandem_proto::pb::learner_client::LearnerClient;
use tandem_proto::pb::learner_server::{Learner, LearnerServer};
use tokio::sync::OnceCell;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

use crate::error::Error;
use crate::service::check_version;
use crate::shared::KEPT_VERSIONS;

/// How long the learner may take to answer; a question for work is held there for some seconds.
const ANSWER: Duration = Duration::from_secs(20);

/// Serves workers at `incoming` on behalf of the learner at `learner`, until `shutdown` is cancelled.
///
/// # Errors
/// When `learner` is no address, or the relay can no longer be reached.
pub async fn serve(
    learner: &str,
    dial: &ClientConfig,
    gate: &ServerConfig,
    incoming: impl Into<Incoming>,
    shutdown: CancellationToken,
) -> Result<(), Error> {
    let link = dial.channel(learner).map_err(Error::Address)?;
    let client = LearnerClient::new(link)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES);
    let relay = Relay { client, cache: Mutex::default() };
    let server = LearnerServer::new(relay).max_decoding_message_size(MAX_MESSAGE_BYTES);
    let router = gate.router(server, tandem_proto::FILE_DESCRIPTOR_SET).await?;
    Ok(tandem_net::serve(router, incoming, shutdown).await?)
}

struct Relay {
    client: LearnerClient<AuthChannel>,
    cache: Mutex<Cache>,
}

/// The parameters that one start of a learner has published.
#[derive(Debug, Default)]
struct Cache {
    /// Which start that is; another learner's version 3 is another one.
    learner: u64,
    versions: BTreeMap<u64, Arc<OnceCell<EncodedResponse>>>,
}

impl Cache {
    /// Forgets everything when `learner` is another start than the one that is known.
    fn belongs_to(&mut self, learner: u64) {
        if self.learner != learner {
            *self = Self { learner, versions: BTreeMap::new() };
        }
    }

    /// The place of a version: all that want it wait there for the one that fetches it.
    fn place_of(&mut self, version: u64) -> Arc<OnceCell<EncodedResponse>> {
        let place = self.versions.entry(version).or_default().clone();
        while self.versions.len() > KEPT_VERSIONS {
            self.versions.pop_first();
        }
        place
    }

    /// Frees the place of a version that could not be fetched: any number can be asked for.
    fn free(&mut self, version: u64) {
        if self.versions.get(&version).is_some_and(|place| !place.initialized()) {
            self.versions.remove(&version);
        }
    }
}

impl Relay {
    fn cache(&self) -> MutexGuard<'_, Cache> {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }

    async fn fetch(&self, version: u64) -> Result<EncodedResponse, Status> {
        let mut client = self.client.clone();
        let request = pb::GetParametersRequest { version };
        let parameters = answer(client.get_parameters(request)).await?;
        Ok(EncodedResponse::encode(parameters.get_ref()))
    }
}

#[tonic::async_trait]
impl Learner for Relay {
    type WatchStream = Streaming<pb::Progress>;

    async fn join(
        &self,
        request: Request<pb::JoinRequest>,
    ) -> Result<Response<pb::JoinResponse>, Status> {
        let request = request.into_inner();
        // Of what another version says, this one would pass on only what it knows itself.
        check_version(&request.worker, &request.version, "relay")?;
        let answer = answer(self.client.clone().join(request)).await?;
        self.cache().belongs_to(answer.get_ref().learner);
        Ok(answer)
    }

    async fn next_work(
        &self,
        request: Request<pb::NextWorkRequest>,
    ) -> Result<Response<pb::NextWorkResponse>, Status> {
        answer(self.client.clone().next_work(request.into_inner())).await
    }

    async fn get_parameters(
        &self,
        request: Request<pb::GetParametersRequest>,
    ) -> Result<Response<pb::Parameters>, Status> {
        let version = request.into_inner().version;
        let place = self.cache().place_of(version);
        match place.get_or_try_init(|| self.fetch(version)).await {
            Ok(prepared) => Ok(prepared.clone().into_response()),
            Err(status) => {
                self.cache().free(version);
                Err(status)
            }
        }
    }

    async fn submit_episodes(
        &self,
        request: Request<pb::SubmitEpisodesRequest>,
    ) -> Result<Response<pb::SubmitEpisodesResponse>, Status> {
        answer(self.client.clone().submit_episodes(request.into_inner())).await
    }

    async fn status(
        &self,
        request: Request<pb::StatusRequest>,
    ) -> Result<Response<pb::Progress>, Status> {
        answer(self.client.clone().status(request.into_inner())).await
    }

    async fn watch(
        &self,
        request: Request<pb::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        answer(self.client.clone().watch(request.into_inner())).await
    }
}

/// Waits for the learner no longer than a worker would.
async fn answer<T>(
    call: impl Future<Output = Result<Response<T>, Status>>,
) -> Result<Response<T>, Status> {
    // The learner's own headers, such as its date, are not this answer's.
    Ok(Response::new(within(ANSWER, call).await?.into_inner()))
}
