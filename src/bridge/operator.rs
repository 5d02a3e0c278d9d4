//! Commands of an operator: status, describe, stop and reset.

use std::time::Duration;

use serde_json::json;
use tandem_net::AuthChannel;
use tandem_proto::pb;
use tandem_proto::pb::bridge_client::BridgeClient;
use tonic::{Code, Response, Status};

use super::show;
use crate::cli::{ConnectArgs, OperatorArgs};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{access, call_failure, output, runtime};

/// Timeout of a call.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Timeout of a stop, after which the operator has to use the emergency stop: as on the operator page.
const STOP_TIMEOUT: Duration = Duration::from_secs(4);

pub(super) type Client = BridgeClient<AuthChannel>;

/// Runs `work` with a client of the bridge in `args`.
pub(super) fn with_client<F: Future<Output = Result<(), Failed>>>(
    args: &ConnectArgs,
    work: impl FnOnce(Client) -> F,
) -> Result<(), Failed> {
    let client_config = access::client_config(&args.client_config, &args.secret)?;
    let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let link = client_config.channel(&args.connect).or_exit(Exit::Usage, String::new)?;
        work(BridgeClient::new(link)).await
    })
}

/// Runs a call with a timeout.
pub(super) async fn call_with_timeout<T>(
    call: impl Future<Output = Result<Response<T>, Status>>,
) -> Result<T, Failed> {
    within(TIMEOUT, call).await?.map_err(|status| failed(&status))
}

/// Stops the arms, or reports after [`STOP_TIMEOUT`] that the bridge has not confirmed it.
pub(super) async fn stop_arms(client: &mut Client) -> Result<pb::StopResponse, Failed> {
    let answer = within(STOP_TIMEOUT, client.stop(pb::StopRequest {})).await?;
    answer.map_err(|status| failed(&status))
}

/// Runs a call for at most `timeout`. Returns its response or status.
async fn within<T>(
    timeout: Duration,
    call: impl Future<Output = Result<Response<T>, Status>>,
) -> Result<Result<T, Status>, Failed> {
    match tokio::time::timeout(timeout, call).await {
        Ok(answer) => Ok(answer.map(Response::into_inner)),
        Err(_elapsed) => {
            let what = anyhow::anyhow!("the bridge did not respond within {timeout:?}");
            Err(Failed::new(Exit::TryAgain, what))
        }
    }
}

/// Converts the status of a failed call.
pub(super) fn failed(status: &Status) -> Failed {
    call_failure::failed(exit(status), status, "start one with `tandem bridge --driver sim`")
}

fn exit(status: &Status) -> Exit {
    match status.code() {
        Code::Unauthenticated | Code::Unimplemented => Exit::Usage,
        Code::InvalidArgument | Code::OutOfRange => Exit::Data,
        Code::Internal => Exit::Bug,
        _ => Exit::TryAgain,
    }
}

/// Acquires the lease on the arms and returns its token.
pub(super) async fn acquire(client: &mut Client) -> Result<String, Failed> {
    Ok(call_with_timeout(client.acquire(pb::AcquireRequest::default())).await?.token)
}

/// Releases the lease. If the call fails, the lease expires soon.
pub(super) async fn release(client: &mut Client, token: String) {
    call_with_timeout(client.release(pb::ReleaseRequest { token })).await.ok();
}

pub(super) fn status(args: &OperatorArgs) -> Result<(), Failed> {
    with_client(&args.connect, async |mut client: Client| {
        let status = call_with_timeout(client.status(pb::BridgeStatusRequest {})).await?;
        if args.json {
            output::print(show::status_json(&status))?;
        } else {
            show::status_lines(&status).iter().try_for_each(output::print)?;
        }
        Ok(())
    })
}

pub(super) fn describe(args: &OperatorArgs) -> Result<(), Failed> {
    with_client(&args.connect, async |mut client: Client| {
        let description = call_with_timeout(client.describe(pb::DescribeBridgeRequest {})).await?;
        if args.json {
            output::print(show::description_json(&description))?;
        } else {
            show::description_lines(&description).iter().try_for_each(output::print)?;
        }
        Ok(())
    })
}

pub(super) fn stop(args: &OperatorArgs) -> Result<(), Failed> {
    with_client(&args.connect, async |mut client: Client| {
        let answer = within(STOP_TIMEOUT, client.stop(pb::StopRequest {})).await;
        let response = answer.and_then(|answer| {
            answer.map_err(|status| call_failure::failed(exit(&status), &status, ""))
        });
        let not_confirmed = "the stop is not confirmed, use the emergency stop";
        let stopped = response.map_err(|failed| failed.context(not_confirmed.to_owned()))?.stopped;
        if args.json {
            output::print(json!({"stopped": stopped.as_ref().map(show::stop_json)}))?;
        } else {
            output::print("stopped")?;
            if let Some(stop) = stopped.filter(|stop| stop.name != "requested") {
                output::print(format_args!("the arms were already stopped: {}", stop.sentence))?;
            }
        }
        Ok(())
    })
}

pub(super) fn reset(args: &OperatorArgs) -> Result<(), Failed> {
    with_client(&args.connect, async |mut client: Client| {
        let token = acquire(&mut client).await?;
        let reset =
            call_with_timeout(client.reset(pb::ResetRequest { token: token.clone() })).await;
        release(&mut client, token).await;
        reset?;
        if args.json {
            output::print(json!({"reset": true}))?;
        } else {
            output::print("reset: the arms hold their position until a motion begins")?;
        }
        Ok(())
    })
}
