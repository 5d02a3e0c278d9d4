//! Damaged, truncated and forged policy files are refused with a reason and never load as a different policy.

use std::collections::BTreeMap;
use std::error::Error as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use proptest::collection::vec;
use proptest::prelude::{
    BoxedStrategy, Just, ProptestConfig, Strategy as _, any, prop_assert, prop_oneof, proptest,
};
use proptest::sample::select;
use serde_json::{Map, Value, json};
use tandem_core::{Layout, Task};
use tandem_policy::{Error, FormatError, MlpShape, NormalizerSnapshot, Policy};

/// A small policy whose numbers are all different.
fn policy() -> Policy {
    let layout = Layout::new(Task::Push, 1);
    let (actor, critic) = (MlpShape::actor(layout, 3, 1), MlpShape::critic(layout, 3, 1, 1));
    let mut next = 0_u16;
    let mut numbers = |n: usize| -> Vec<f32> {
        let number = |_| {
            next += 1;
            f32::from(next) / 1024.0
        };
        (0..n).map(number).collect()
    };
    let mut normalizer = |n| NormalizerSnapshot { mean: numbers(n), std: numbers(n) };
    let (observation_normalizer, goal_normalizer) =
        (normalizer(layout.n_observation()), normalizer(layout.n_goal()));
    Policy {
        task: layout.into(),
        n_hidden: 3,
        n_hidden_layers: 1,
        n_heads: 1,
        actor: numbers(actor.n_parameters()),
        critic: numbers(critic.n_parameters()),
        observation_normalizer,
        goal_normalizer,
        metadata: BTreeMap::from([("trained".to_owned(), "for a test".to_owned())]),
    }
}

/// The file of this policy.
fn whole() -> Vec<u8> {
    static WHOLE: LazyLock<Vec<u8>> = LazyLock::new(|| {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("whole.safetensors");
        policy().save(&path).expect("a usable policy");
        std::fs::read(path).expect("written")
    });
    WHOLE.clone()
}

/// Loads a policy from `bytes`. An error must name the file and give a reason of readable length.
fn load(bytes: &[u8]) -> Result<Policy, FormatError> {
    let mut file = tempfile::Builder::new().prefix("policy-").tempfile().expect("a file");
    file.write_all(bytes).expect("written");
    Policy::load(file.path()).map_err(|error| {
        let name = file.path().file_name().expect("a name").to_string_lossy().into_owned();
        assert!(error.to_string().contains(&name), "{error} does not name {name}");
        let reason = error.source().expect("a reason").to_string();
        assert!((10..400).contains(&reason.len()), "{} bytes: {reason:.400}", reason.len());
        let Error::Refused { source, .. } = error else { unreachable!("it was read") };
        *source
    })
}

/// Returns `true` if two policies are equal except for their metadata.
fn equal_networks(one: &Policy, other: &Policy) -> bool {
    Policy { metadata: BTreeMap::new(), ..one.clone() }
        == Policy { metadata: BTreeMap::new(), ..other.clone() }
}

/// Splits a file into its header and its numbers.
fn split(bytes: &[u8]) -> (Map<String, Value>, &[u8]) {
    let (length, rest) = bytes.split_first_chunk::<8>().expect("a length");
    let n_bytes = usize::try_from(u64::from_le_bytes(*length)).expect("a small header");
    let (header, numbers) = rest.split_at(n_bytes);
    (serde_json::from_slice(header).expect("a header"), numbers)
}

fn joined(header: &str, numbers: &[u8]) -> Vec<u8> {
    [&(header.len() as u64).to_le_bytes(), header.as_bytes(), numbers].concat()
}

#[test]
fn a_flipped_bit_never_gives_a_different_policy() {
    let whole = whole();
    let n_header = 8 + usize::from(u16::from_le_bytes([whole[0], whole[1]]));
    let mut bytes = whole.clone();
    for at in 0..bytes.len() {
        for bit in 0..8 {
            bytes[at] ^= 1 << bit;
            match load(&bytes) {
                Ok(loaded) => {
                    assert!(at < n_header, "number at byte {at}, bit {bit}");
                    assert!(equal_networks(&loaded, &policy()), "byte {at}, bit {bit}");
                }
                Err(FormatError::Digest { .. }) => {}
                Err(error) => {
                    let may_be = at < n_header || matches!(error, FormatError::Unusable(_));
                    assert!(may_be, "byte {at}, bit {bit}: {error}");
                }
            }
            bytes[at] = whole[at];
        }
    }
}

#[test]
fn truncated_and_extended_files_are_refused() {
    let whole = whole();
    for n_bytes in 0..whole.len() {
        let error = load(&whole[..n_bytes]).expect_err("truncated");
        assert!(matches!(error, FormatError::NotSafetensors { .. }), "{n_bytes} bytes: {error}");
    }
    for n_more in [1, 4, 4096] {
        assert!(load(&[whole.as_slice(), &vec![0; n_more]].concat()).is_err(), "{n_more} more");
    }
}

#[test]
fn headers_with_a_wrong_length_are_refused() {
    let whole = whole();
    for length in [0, 1, 7, 100_000_001, 1 << 40, u64::MAX - 7, u64::MAX] {
        let bytes = [&length.to_le_bytes(), &whole[8..]].concat();
        assert!(load(&bytes).is_err(), "length {length}");
    }
    let deep = "[".repeat(100_000);
    for header in [deep.as_str(), "null", "[]", "{}", "{\"__metadata__\":3}", "\"x\"", "{\"a\":"] {
        assert!(load(&joined(header, &[])).is_err(), "{header:.20}");
    }
}

#[test]
fn a_duplicate_tensor_never_gives_a_different_policy() {
    let whole = whole();
    let (header, numbers) = split(&whole);
    let text = Value::Object(header.clone()).to_string();
    for (name, entry) in header.iter().filter(|(name, _)| *name != "__metadata__") {
        let mut other = entry.clone();
        other["data_offsets"] = json!([0, 12]);
        for second in [entry.to_string(), other.to_string()] {
            let doubled = text.replacen('{', &format!("{{{name:?}:{second},"), 1);
            if let Ok(loaded) = load(&joined(&doubled, numbers)) {
                assert!(equal_networks(&loaded, &policy()), "{name}: {second}");
            }
        }
    }
}

#[test]
fn tensors_of_another_type_are_refused() {
    let whole = whole();
    for dtype in ["F16", "BF16", "F64", "I32", "U32", "I64", "BOOL", "F8_E4M3", "f32", "", "X"] {
        let (mut header, numbers) = split(&whole);
        header["actor.layers.1.bias"]["dtype"] = dtype.into();
        let error = load(&joined(&Value::Object(header).to_string(), numbers)).expect_err(dtype);
        let is_named = error.to_string().contains("actor.layers.1.bias");
        assert!(
            is_named || matches!(error, FormatError::NotSafetensors { .. }),
            "{dtype}: {error}"
        );
    }
}

#[test]
fn reasons_are_short_for_long_entries() {
    let whole = whole();
    let long = "long ".repeat(50_000);
    for key in ["format", "format_version", "task", "n_arms", "n_hidden", "activation", "digest"] {
        let (mut header, numbers) = split(&whole);
        header["__metadata__"][key] = long.clone().into();
        let bytes = joined(&Value::Object(header).to_string(), numbers);
        assert!(load(&bytes).is_err(), "{key}");
    }
    let (mut header, numbers) = split(&whole);
    let end = numbers.len();
    header.insert(long, json!({"dtype": "F32", "shape": [0], "data_offsets": [end, end]}));
    let error = load(&joined(&Value::Object(header).to_string(), numbers)).expect_err("unknown");
    assert!(matches!(error, FormatError::UnknownTensor { .. }), "{error}");
}

#[test]
fn every_shipped_policy_has_its_digest() {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("../policies");
    let mut n_policies = 0;
    let files = std::fs::read_dir(directory).expect("shipped policies").flatten();
    let is_policy = |path: &PathBuf| path.extension().is_some_and(|it| it == "safetensors");
    for path in files.map(|entry| entry.path()).filter(is_policy) {
        let loaded = Policy::load(&path).expect("usable");
        let (header, _) = {
            let bytes = std::fs::read(&path).expect("readable");
            let (header, numbers) = split(&bytes);
            (header, numbers.len())
        };
        assert_eq!(header["__metadata__"]["digest"], loaded.digest(), "{}", path.display());
        n_policies += 1;
    }
    assert!(n_policies >= 3);
}

/// A change of a header's JSON.
#[derive(Debug, Clone)]
enum Edit {
    Remove(usize),
    Rename(usize, String),
    Add(String, Value),
    Replace(usize, &'static str, Value),
    Describe(usize, Value),
}

fn any_json() -> BoxedStrategy<Value> {
    let number = prop_oneof![
        4 => (0_u64..2000).prop_map(Value::from),
        1 => any::<u64>().prop_map(Value::from),
        1 => any::<i64>().prop_map(Value::from),
        1 => any::<f64>().prop_map(Value::from),
        1 => select(vec![u64::MAX, u64::MAX / 4, 1 << 62]).prop_map(Value::from),
    ];
    let text = prop_oneof!["[a-zF0-9-]{0,6}", any::<String>()];
    prop_oneof![
        2 => number.clone(),
        2 => text.prop_map(Value::from),
        4 => vec(number, 0..4).prop_map(Value::from),
        1 => Just(Value::Null),
        1 => Just(json!({})),
    ]
    .boxed()
}

fn any_edit() -> BoxedStrategy<Edit> {
    let name =
        prop_oneof!["[a-z0-9.]{1,12}", Just("critic.1.layers.0.bias".to_owned()), any::<String>()];
    let entry = (select(vec!["F32", "F64", "U8"]), any_json(), any_json()).prop_map(
        |(dtype, shape, offsets)| json!({"dtype": dtype, "shape": shape, "data_offsets": offsets}),
    );
    let part = select(vec!["dtype", "shape", "data_offsets"]);
    prop_oneof![
        1 => any::<usize>().prop_map(Edit::Remove),
        1 => (any::<usize>(), name.clone()).prop_map(|(at, name)| Edit::Rename(at, name)),
        1 => (name, entry).prop_map(|(name, entry)| Edit::Add(name, entry)),
        4 => (any::<usize>(), part, any_json()).prop_map(|(at, part, value)| Edit::Replace(at, part, value)),
        2 => (any::<usize>(), any_json()).prop_map(|(at, value)| Edit::Describe(at, value)),
    ]
    .boxed()
}

fn apply(header: &mut Map<String, Value>, edit: Edit) {
    let names: Vec<String> =
        header.keys().filter(|name| *name != "__metadata__").cloned().collect();
    let pick = |at: usize| names.get(at % names.len().max(1)).cloned();
    match edit {
        Edit::Remove(at) => drop(pick(at).and_then(|name| header.shift_remove(&name))),
        Edit::Rename(at, to) => {
            if let Some(entry) = pick(at).and_then(|name| header.shift_remove(&name)) {
                header.insert(to, entry);
            }
        }
        Edit::Add(name, entry) => drop(header.insert(name, entry)),
        Edit::Replace(at, part, value) => {
            if let Some(entry) = pick(at).and_then(|name| header.get_mut(&name)?.get_mut(part)) {
                *entry = value;
            }
        }
        Edit::Describe(at, value) => {
            let metadata = header.get_mut("__metadata__").and_then(Value::as_object_mut);
            if let Some(metadata) = metadata {
                let keys: Vec<String> =
                    metadata.keys().filter(|key| *key != "digest").cloned().collect();
                metadata.insert(keys[at % keys.len()].clone(), value);
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn an_edited_header_never_gives_a_different_policy(edits in vec(any_edit(), 1..4)) {
        let whole = whole();
        let (mut header, numbers) = split(&whole);
        edits.into_iter().for_each(|edit| apply(&mut header, edit));
        let bytes = joined(&Value::Object(header).to_string(), numbers);
        if let Ok(loaded) = load(&bytes) {
            prop_assert!(equal_networks(&loaded, &policy()));
        }
    }

    #[test]
    fn random_bytes_are_refused(bytes in vec(any::<u8>(), 0..200), n_header in 0_u64..64) {
        prop_assert!(load(&bytes).is_err());
        prop_assert!(load(&[&n_header.to_le_bytes(), bytes.as_slice()].concat()).is_err());
    }
}
