//! Writes sample files that no short run produces: a ledger with open leases, and encoded messages of every type.
//!
//! `scripts/make-corpus` runs it with the output directory as argument.

use std::fs;
use std::path::{Path, PathBuf};

use prost_reflect::prost::Message as _;
use prost_reflect::{
    DescriptorPool, DynamicMessage, FieldDescriptor, Kind, MessageDescriptor, Value,
};
use serde_json::json;
use tandem_teacher::budget::{AccountTerms, BudgetHalves, Charge};
use tandem_teacher::ledger::{ChargeRequest, Ledger as _, SqliteLedger};

type AnyError = Box<dyn std::error::Error>;

/// Largest number of alternatives in a `oneof`.
const N_VARIANTS: usize = 4;

fn main() -> Result<(), AnyError> {
    let directory = std::env::args_os().nth(1).map(PathBuf::from).ok_or("expected a directory")?;
    write_ledger(&directory.join("ledger.sqlite"))?;
    write_messages(&directory.join("messages.json"))
}

/// Writes two accounts: one without leases, and one with a settled lease, an open lease and charges under both.
fn write_ledger(path: &Path) -> Result<(), AnyError> {
    if path.exists() {
        return Err(format!("{path:?} already exists").into());
    }
    let mut ledger = SqliteLedger::open(path)?;
    let unleased = AccountTerms { budget: 10, strategy: "mc-q:0.1".parse()? };
    let leased = AccountTerms { budget: 1000, strategy: "eamc:0.25".parse()? };
    ledger.open("unleased", unleased)?;
    ledger.open("leased", leased)?;
    ledger.open_leases("leased", &[0, 1], 50)?;
    let of_unleased = |charges| ChargeRequest {
        account: "unleased".to_owned(),
        strategy: unleased.strategy,
        episode_steps: 50,
        charges,
    };
    let of_leased = |charges| ChargeRequest {
        account: "leased".to_owned(),
        strategy: leased.strategy,
        ..of_unleased(charges)
    };
    let charges = |episode, steps: std::ops::Range<u32>, wanted_in| -> Vec<Charge> {
        steps.map(|step| Charge { episode, step, wanted_in }).collect()
    };
    let (always, never) = (BudgetHalves::BOTH, BudgetHalves::NONE);
    for bill in [
        of_unleased(charges(3, 0..12, always)),
        of_leased(charges(0, 0..20, always)),
        of_leased(charges(0, 20..50, never)),
        of_leased(charges(1, 0..5, always)),
    ] {
        ledger.charge(&[bill]).into_iter().collect::<Result<Vec<_>, _>>()?;
    }
    ledger.settle("leased", &[0])?;
    drop(ledger);
    Ok(())
}

/// Writes every message type of the package with every field set, once for each alternative of its `oneof`s.
fn write_messages(path: &Path) -> Result<(), AnyError> {
    let pool = DescriptorPool::decode(tandem_proto::FILE_DESCRIPTOR_SET)?;
    let mut samples = Vec::new();
    for message in pool.all_messages().filter(|it| it.package_name() == "tandem.v1") {
        let mut encoded = Vec::new();
        for variant in 0..N_VARIANTS {
            let sample = filled(&message, variant, &mut 0);
            let bytes = sample.encode_to_vec();
            if encoded.contains(&bytes) {
                continue;
            }
            let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
            let content = sample.to_text_format();
            samples.push(json!({ "message": message.name(), "bytes": hex, "content": content }));
            encoded.push(bytes);
        }
    }
    fs::write(path, serde_json::to_string_pretty(&samples)? + "\n")?;
    Ok(())
}

/// Creates a message with every field set, and alternative `variant` of each `oneof`. `n` counts values, so that all
/// differ.
fn filled(message: &MessageDescriptor, variant: usize, n: &mut u32) -> DynamicMessage {
    let mut filled = DynamicMessage::new(message.clone());
    for field in message.fields().filter(|field| is_chosen(field, variant)) {
        let value = if field.is_list() {
            Value::List(vec![value_of(&field, variant, n), value_of(&field, variant, n)])
        } else {
            value_of(&field, variant, n)
        };
        filled.set_field(&field, value);
    }
    filled
}

fn is_chosen(field: &FieldDescriptor, variant: usize) -> bool {
    field.containing_oneof().is_none_or(|oneof| {
        let alternatives: Vec<_> = oneof.fields().collect();
        alternatives[variant % alternatives.len()] == *field
    })
}

fn value_of(field: &FieldDescriptor, variant: usize, n: &mut u32) -> Value {
    *n += 1;
    match field.kind() {
        Kind::Bool => Value::Bool(true),
        Kind::Float => Value::F32(*n as f32 + 0.25),
        Kind::Double => Value::F64(f64::from(*n) + 0.125),
        Kind::Uint32 | Kind::Fixed32 => Value::U32(*n + 1000),
        Kind::Uint64 | Kind::Fixed64 => Value::U64(u64::from(*n) + (1 << 40)),
        Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 => Value::I32(-1),
        Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 => Value::I64(-1),
        Kind::String => Value::String(format!("text {n}")),
        Kind::Bytes => Value::Bytes(n.to_le_bytes().to_vec().into()),
        Kind::Enum(kinds) => {
            let numbers: Vec<i32> = kinds.values().map(|value| value.number()).collect();
            Value::EnumNumber(numbers[(variant + 1) % numbers.len()])
        }
        Kind::Message(message) => Value::Message(filled(&message, variant, n)),
    }
}
