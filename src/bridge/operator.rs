//! What operators ask of a bridge.

use std::time::Duration;

use serde_json::json;
use tandem_net::AuthChannel;
use tandem_proto::pb;
use tandem_proto::pb::bridge_client::BridgeClient;
use tonic::{Code, Response, Status};

use super::show;
use crate::cli::{ConnectArgs, OperatorArgs};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{access, output, services};

/// How long a call may take.
const DEADLINE: Duration = Duration::from_secs(10);

pub(super) type Client = BridgeClient<AuthChannel>;

/// Runs `work` with a client of the bridge that `args` name.
pub(super) fn with_client<F: Future<Output = Result<(), Failed>>>(
    args: &ConnectArgs,
    work: impl FnOnce(Client) -> F,
) -> Result<(), Failed> {
    let dial = access::dial(&args.dial, &args.secret)?;
    let runtime = services::runtime().or_exit(Exit::TryAgain, String::new)?;
    runtime.block_on(async {
        let link = dial.channel(&args.connect).or_exit(Exit::Usage, String::new)?;
        work(BridgeClient::new(link)).await
    })
}

/// The answer to a call, in time.
pub(super) async fn answer<T>(
    call: impl Future<Output = Result<Response<T>, Status>>,
) -> Result<T, Failed> {
    match tokio::time::timeout(DEADLINE, call).await {
        Ok(Ok(answer)) => Ok(answer.into_inner()),
        Ok(Err(status)) => Err(failed(&status)),
        Err(_elapsed) => {
            let what = anyhow::anyhow!("the bridge has not answered within {DEADLINE:?}");
            Err(Failed::new(Exit::TryAgain, what))
        }
    }
}

/// What a person is told of a call that failed.
pub(super) fn failed(status: &Status) -> Failed {
    let exit = match status.code() {
        Code::Unauthenticated | Code::Unimplemented => Exit::Usage,
        Code::InvalidArgument | Code::OutOfRange => Exit::Data,
        Code::Internal => Exit::Bug,
        _ => Exit::TryAgain,
    };
    Failed::new(exit, anyhow::anyhow!("{}", status.message()))
}

/// A lease of its own.
pub(super) async fn acquire(client: &mut Client) -> Result<String, Failed> {
    Ok(answer(client.acquire(pb::AcquireRequest::default())).await?.token)
}

/// Gives the arms up. Whoever cannot loses them soon anyway.
pub(super) async fn release(client: &mut Client, token: String) {
    answer(client.release(pb::ReleaseRequest { token })).await.ok();
}

pub(super) fn status(args: &OperatorArgs) -> Result<(), Failed> {
    with_client(&args.connect, async |mut client: Client| {
        let status = answer(client.status(pb::BridgeStatusRequest {})).await?;
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
        let told = answer(client.describe(pb::DescribeBridgeRequest {})).await?;
        if args.json {
            output::print(show::description_json(&told))?;
        } else {
            show::description_lines(&told).iter().try_for_each(output::print)?;
        }
        Ok(())
    })
}

pub(super) fn stop(args: &OperatorArgs) -> Result<(), Failed> {
    with_client(&args.connect, async |mut client: Client| {
        let stopped = answer(client.stop(pb::StopRequest {})).await?.stopped;
        if args.json {
            output::print(json!({"stopped": stopped.as_ref().map(show::stop_json)}))?;
        } else {
            output::print("stopped")?;
            if let Some(stop) = stopped.filter(|stop| stop.name != "requested") {
                output::print(format_args!("they were stopped before: {}", stop.sentence))?;
            }
        }
        Ok(())
    })
}

pub(super) fn reset(args: &OperatorArgs) -> Result<(), Failed> {
    with_client(&args.connect, async |mut client: Client| {
        let token = acquire(&mut client).await?;
        let reset = answer(client.reset(pb::ResetRequest { token: token.clone() })).await;
        release(&mut client, token).await;
        reset?;
        if args.json {
            output::print(json!({"reset": true}))?;
        } else {
            output::print("reset: the arms stay where they are until a motion begins")?;
        }
        Ok(())
    })
}
