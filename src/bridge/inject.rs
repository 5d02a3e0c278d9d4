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
            Some(fault) if !args.clear => Action::Fault(injection(&mut client, fault, args).await?),
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

/// Returns the injection of `fault` at the arm and joint of the command line.
async fn injection(
    client: &mut Client,
    fault: FaultName,
    args: &InjectArgs,
) -> Result<pb::FaultInjection, Failed> {
    let needs_joint =
        matches!(fault, FaultName::BlockedJoint | FaultName::Torque | FaultName::Drift);
    if args.joint.is_some() && !needs_joint {
        return Err(Failed::usage("--joint belongs to blocked-joint, torque and drift"));
    }
    if args.arm.is_some() && fault == FaultName::LateStates {
        return Err(Failed::usage("--arm does not belong to late-states, which delays both arms"));
    }
    let description = call_with_timeout(client.describe(pb::DescribeBridgeRequest {})).await?;
    let (arm, found) = match &args.arm {
        None => (0, description.arms.first()),
        Some(text) => {
            let mut arms = (0_u32..).zip(&description.arms);
            let found = arms.find(|(idx, arm)| arm.name == *text || idx.to_string() == *text);
            let (idx, arm) = found.ok_or_else(|| {
                let names: Vec<&str> =
                    description.arms.iter().map(|arm| arm.name.as_str()).collect();
                Failed::usage(format!("--arm {text:?}: the arms are {}", names.join(" and ")))
            })?;
            (idx, Some(arm))
        }
    };
    let n_joints = found.map_or(0, |arm| arm.joints.len());
    let joint = args.joint.unwrap_or(1);
    if usize::try_from(joint).map_or(true, |joint| joint > n_joints) {
        return Err(Failed::usage(format!("--joint {joint}: the arm has joints 1 to {n_joints}")));
    }
    Ok(pb::FaultInjection { fault: fault_code(fault).into(), arm, joint: joint - 1 })
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
