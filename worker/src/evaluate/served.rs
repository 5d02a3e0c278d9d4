//! Evaluation in the environments of a server.

use tandem_core::work::{RunTerms, SlotOrder};
use tandem_core::{Episode, TaskSpec};
use tokio::sync::oneshot;

use super::{evaluation_terms, slot_of};
use crate::config::EnvironmentConfig;
use crate::environment::{EnvironmentClient, Failure};
use crate::error::Error;
use crate::player::PeerChannel;
use crate::ports::{Act, NoAdvisor};
use crate::rollout::{RolloutError, play_slot};

/// The largest number of episodes that are stepped in lock step. It does not affect the result.
const MAX_EPISODES: usize = 16;

/// Plays `n_episodes` episodes of `task`, numbered from 0, in the environments of a server, and calls `take` with some
/// of them at a time, in order. `seed` determines their starts and goals.
///
/// After a failure of the server the episodes in play are repeated from their starts, as a worker does.
///
/// # Errors
/// When the server serves another task, cannot be started, or keeps failing.
pub async fn evaluate_served<A: Act + Clone + Send + 'static>(
    config: EnvironmentConfig,
    actor: A,
    task: &TaskSpec,
    (n_episodes, seed): (u64, u64),
    take: &mut dyn FnMut(Vec<Episode>),
) -> Result<(), Error> {
    let mut environments = EnvironmentClient::new(config);
    let n_per_slot = environments.check(task).await?.min(MAX_EPISODES);
    let terms = evaluation_terms(task);
    for first in (0..n_episodes).step_by(n_per_slot) {
        let order = slot_of((first..n_episodes).take(n_per_slot), seed);
        take(play(&mut environments, &actor, &order, &terms).await?);
    }
    Ok(())
}

/// Plays a slot, and repeats it after failures of the server.
async fn play<A: Act + Clone + Send + 'static>(
    environments: &mut EnvironmentClient,
    actor: &A,
    order: &SlotOrder,
    terms: &RunTerms,
) -> Result<Vec<Episode>, Error> {
    loop {
        match try_play(environments, actor.clone(), order, terms).await {
            Ok(played) => {
                environments.succeed().await;
                return played.map_err(|source| Error::Rollout { slot: order.slot, source });
            }
            Err(failure) => environments.recover(failure).await?,
        }
    }
}

/// Plays a slot on a thread of its own, and forwards its requests to the server.
async fn try_play<A: Act + Send + 'static>(
    environments: &mut EnvironmentClient,
    mut actor: A,
    order: &SlotOrder,
    terms: &RunTerms,
) -> Result<Result<Vec<Episode>, RolloutError>, Failure> {
    let (mut peers, mut requests) = PeerChannel::new();
    let (finished, playing) = oneshot::channel();
    let (order, task, terms) = (order.clone(), terms.task.clone(), terms.clone());
    let spawned = std::thread::Builder::new().name("rollout".to_owned()).spawn(move || {
        let played = play_slot(&mut peers, &order, &terms, &mut actor, &mut NoAdvisor);
        // Fails only if the evaluation was abandoned meanwhile.
        drop(finished.send(played));
    });
    spawned.map_err(|error| Failure::Final(Box::new(Error::Thread(error))))?;
    while let Some(request) = requests.recv().await {
        if !environments.answer(request, &task).await? {
            break;
        }
    }
    drop(requests);
    playing.await.map_err(|panicked| Failure::Final(Box::new(panicked.into())))
}
