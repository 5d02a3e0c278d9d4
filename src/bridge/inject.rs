//! `tandem bridge inject`: faults of simulated arms, so that operators can practise each stop.

use serde_json::json;
use tandem_proto::pb;
use tandem_proto::pb::inject_request::Action;

use super::operator::{Client, call_with_timeout, with_client};
use super::show;
use crate::cli::{FaultName, InjectArgs};
use crate::exit::Failed;
use crate::output;

pub(super) fn inject(args: &InjectArgs) -> Result<(), Failed> {
    with_client(&args.connect, async |mut client: Client| {
        let action = match args.fault {
            Some(fault) if !args.clear => {
                let arm = arm(&mut client, &args.arm).await?;
                let fault = fault_code(fault).into();
                Action::Fault(pb::FaultInjection { fault, arm, joint: args.joint - 1 })
            }
            _ => Action::Clear(pb::ClearFaults {}),
        };
        let request = pb::InjectRequest { action: Some(action) };
        let injected = call_with_timeout(client.inject(request)).await?.injected;
        if args.json {
            return output::print(json!({"injected": show::injected_json(&injected)}));
        }
        if injected.is_empty() {
            return output::print("no faults: reset the arms with `tandem bridge reset`");
        }
        injected.iter().try_for_each(|fault| {
            output::print(format_args!("injected: {}", show::injected(fault)))
        })
    })
}

/// Returns the index of the arm with this number or name.
async fn arm(client: &mut Client, text: &str) -> Result<u32, Failed> {
    if let Ok(number) = text.parse() {
        return Ok(number);
    }
    let description = call_with_timeout(client.describe(pb::DescribeBridgeRequest {})).await?;
    let arms = (0_u32..).zip(&description.arms);
    let found = arms.clone().find(|(_, arm)| arm.name == text);
    found.map(|(idx, _)| idx).ok_or_else(|| {
        let names: Vec<&str> = description.arms.iter().map(|arm| arm.name.as_str()).collect();
        Failed::usage(format!("--arm {text:?}: the arms are {}", names.join(" and ")))
    })
}

const fn fault_code(fault: FaultName) -> pb::InjectedFault {
    match fault {
        FaultName::EmergencyStop => pb::InjectedFault::EmergencyStop,
        FaultName::DriveFault => pb::InjectedFault::DriveFault,
        FaultName::Contact => pb::InjectedFault::Contact,
        FaultName::BlockedJoint => pb::InjectedFault::BlockedJoint,
        FaultName::Torque => pb::InjectedFault::Torque,
        FaultName::Drift => pb::InjectedFault::Drift,
        FaultName::LateStates => pb::InjectedFault::LateStates,
    }
}
