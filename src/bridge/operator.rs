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
    match tokio::time::timeout(TIMEOUT, call).await {
        Ok(Ok(response)) => Ok(response.into_inner()),
        Ok(Err(status)) => Err(failed(&status)),
        Err(_elapsed) => {
            let what = anyhow::anyhow!("the bridge did not respond within {TIMEOUT:?}");
            Err(Failed::new(Exit::TryAgain, what))
        }
    }
}

/// Converts the status of a failed call.
pub(super) fn failed(status: &Status) -> Failed {
    let exit = match status.code() {
        Code::Unauthenticated | Code::Unimplemented => Exit::Usage,
        Code::InvalidArgument | Code::OutOfRange => Exit::Data,
        Code::Internal => Exit::Bug,
        _ => Exit::TryAgain,
    };
    call_failure::failed(exit, status, "tandem bridge --driver sim")
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
        let stopped = call_with_timeout(client.stop(pb::StopRequest {})).await?.stopped;
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
