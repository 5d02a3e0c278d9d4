//! The policy file: one safetensors file. `docs/policy-format.md` says what stands in it and how to compute with it.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use serde_json::{Map, Value, json};
use tandem_core::{Layout, Task};

use crate::error::{Error, FormatError};
use crate::mlp::MlpShape;
use crate::normalizer::{CLIP, NormalizerSnapshot};
use crate::policy::{MAX_HEADS, MAX_HIDDEN, MAX_HIDDEN_LAYERS, Policy, little_endian};

/// What metadata `format` says.
pub const FORMAT: &str = "tandem-policy";
/// What metadata `format_version` says; another version is refused.
pub const FORMAT_VERSION: &str = "1";

const MAX_ARMS: usize = 64;
/// The header's length is a little-endian `u64`, and headers are filled up to this many bytes.
const HEADER_ALIGNMENT: usize = 8;

impl Policy {
    /// Writes the policy to `path`, whole or not at all.
    ///
    /// # Errors
    /// When a number cannot be used (see [`Policy::check`]) or the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        self.check()?;
        write_atomically(path, &encode(self))
            .map_err(|source| Error::Write { path: path.to_owned(), source })
    }

    /// Reads the policy that `path` holds.
    ///
    /// # Errors
    /// When there is no such file, it was cut short or altered, has another format or version, or any tensor does
    /// not fit the task, the arms and the networks' sizes.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let bytes =
            fs::read(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        decode(&bytes)
            .map_err(|source| Error::Refused { path: path.to_owned(), source: Box::new(source) })
    }
}

/// The bytes of a policy file; equal policies give equal bytes.
fn encode(policy: &Policy) -> Vec<u8> {
    let mut header = Map::new();
    header.insert("__metadata__".to_owned(), json!(metadata(policy)));
    let mut data = Vec::new();
    for tensor in policy.tensors() {
        let start = data.len();
        data.extend(little_endian(tensor.data));
        let entry =
            json!({ "dtype": "F32", "shape": tensor.shape, "data_offsets": [start, data.len()] });
        header.insert(tensor.name, entry);
    }
    let mut header = Value::Object(header).to_string().into_bytes();
    header.resize(header.len().next_multiple_of(HEADER_ALIGNMENT), b' ');
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header);
    bytes.extend(data);
    bytes
}

/// The policy's own metadata and the format's entries.
fn metadata(policy: &Policy) -> BTreeMap<String, String> {
    let mut metadata = policy.metadata.clone();
    metadata.extend(reserved(policy).map(|(key, value)| (key.to_owned(), value)));
    metadata
}

/// The format's entries in the order in which a reader checks them.
fn reserved(policy: &Policy) -> [(&'static str, String); 15] {
    let layout = policy.layout;
    [
        ("format", FORMAT.to_owned()),
        ("format_version", FORMAT_VERSION.to_owned()),
        ("task", layout.task.name().to_owned()),
        ("n_arms", layout.n_arms.to_string()),
        ("n_hidden", policy.n_hidden.to_string()),
        ("n_hidden_layers", policy.n_hidden_layers.to_string()),
        ("n_heads", policy.n_heads.to_string()),
        ("n_observation", layout.n_observation().to_string()),
        ("n_goal", layout.n_goal().to_string()),
        ("n_action", layout.n_action().to_string()),
        ("activation", "relu".to_owned()),
        ("output_activation", "tanh".to_owned()),
        ("action_clip", "1".to_owned()),
        ("normalizer_clip", CLIP.to_string()),
        ("digest", policy.digest()),
    ]
}

fn decode(bytes: &[u8]) -> Result<Policy, FormatError> {
    let source = |source| FormatError::NotSafetensors { source };
    let file = SafeTensors::deserialize(bytes).map_err(source)?;
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(source)?;
    let metadata = header
        .metadata()
        .iter()
        .flatten()
        .map(|(key, value)| (key.clone(), value.clone()))
        .collect();
    let policy = read_policy(&file, metadata)?;
    refuse_unknown_tensors(&file, &policy)?;
    policy.check()?;
    check_reserved(policy)
}

/// Reads sizes and tensors; the sizes are believed only as far as the tensors bear them out.
fn read_policy(
    file: &SafeTensors<'_>,
    metadata: BTreeMap<String, String>,
) -> Result<Policy, FormatError> {
    expect_entry(&metadata, "format", FORMAT)?;
    expect_entry(&metadata, "format_version", FORMAT_VERSION)?;
    let task = parse_task(&metadata)?;
    let layout = Layout::new(task, parse_size(&metadata, "n_arms", MAX_ARMS)?);
    let n_hidden = parse_size(&metadata, "n_hidden", MAX_HIDDEN)?;
    let n_hidden_layers = parse_size(&metadata, "n_hidden_layers", MAX_HIDDEN_LAYERS)?;
    let n_heads = parse_size(&metadata, "n_heads", MAX_HEADS)?;
    let normalizer = |name: &str, size| -> Result<NormalizerSnapshot, FormatError> {
        Ok(NormalizerSnapshot {
            mean: read_tensor(file, &format!("normalizer.{name}.mean"), &[size])?,
            std: read_tensor(file, &format!("normalizer.{name}.std"), &[size])?,
        })
    };
    Ok(Policy {
        layout,
        n_hidden,
        n_hidden_layers,
        n_heads,
        actor: read_network(file, "actor", &MlpShape::actor(layout, n_hidden, n_hidden_layers))?,
        critic: read_network(
            file,
            "critic.0",
            &MlpShape::critic(layout, n_hidden, n_hidden_layers, n_heads),
        )?,
        observation_normalizer: normalizer("observation", layout.n_observation())?,
        goal_normalizer: normalizer("goal", layout.n_goal())?,
        metadata,
    })
}

/// Compares the format's entries with what this version writes for the same tensors, then drops them from the
/// policy's own. A file without a digest is taken as it is: other programs may write one.
fn check_reserved(mut policy: Policy) -> Result<Policy, FormatError> {
    for (key, expected) in reserved(&policy) {
        match (key, policy.metadata.remove(key)) {
            (_, Some(got)) if got == expected => {}
            ("digest", None) => {}
            ("digest", Some(written)) => {
                return Err(FormatError::Digest { got: expected, expected: written });
            }
            (_, Some(got)) => return Err(FormatError::Metadata { key, got, expected }),
            (_, None) => return Err(FormatError::MissingMetadata { key }),
        }
    }
    Ok(policy)
}

fn entry<'a>(
    metadata: &'a BTreeMap<String, String>,
    key: &'static str,
) -> Result<&'a str, FormatError> {
    metadata.get(key).map(String::as_str).ok_or(FormatError::MissingMetadata { key })
}

fn expect_entry(
    metadata: &BTreeMap<String, String>,
    key: &'static str,
    expected: &str,
) -> Result<(), FormatError> {
    let got = entry(metadata, key)?;
    if got == expected {
        return Ok(());
    }
    Err(FormatError::Metadata { key, got: got.to_owned(), expected: format!("{expected:?}") })
}

fn parse_task(metadata: &BTreeMap<String, String>) -> Result<Task, FormatError> {
    let got = entry(metadata, "task")?;
    let expected = || Task::ALL.map(Task::name).join(" or ");
    let refusal =
        |_unknown| FormatError::Metadata { key: "task", got: got.to_owned(), expected: expected() };
    got.parse().map_err(refusal)
}

fn parse_size(
    metadata: &BTreeMap<String, String>,
    key: &'static str,
    most: usize,
) -> Result<usize, FormatError> {
    let got = entry(metadata, key)?;
    match got.parse() {
        Ok(size) if (1..=most).contains(&size) => Ok(size),
        _ => Err(FormatError::Metadata {
            key,
            got: got.to_owned(),
            expected: format!("1 to {most}"),
        }),
    }
}

/// A network's parameters: its tensors one after another.
fn read_network(
    file: &SafeTensors<'_>,
    prefix: &str,
    shape: &MlpShape,
) -> Result<Vec<f32>, FormatError> {
    let mut parameters = Vec::new();
    for layer in 0..shape.n_layers() {
        let (n_out, n_in) = (shape.layer_output(layer), shape.layer_input(layer));
        parameters.extend(read_tensor(
            file,
            &format!("{prefix}.layers.{layer}.weight"),
            &[n_out, n_in],
        )?);
        parameters.extend(read_tensor(file, &format!("{prefix}.layers.{layer}.bias"), &[n_out])?);
    }
    Ok(parameters)
}

fn read_tensor(
    file: &SafeTensors<'_>,
    name: &str,
    shape: &[usize],
) -> Result<Vec<f32>, FormatError> {
    let tensor: TensorView<'_> = file
        .tensor(name)
        .map_err(|_absent| FormatError::MissingTensor { name: name.to_owned() })?;
    if tensor.dtype() != Dtype::F32 || tensor.shape() != shape {
        let got = format!("{} {:?}", tensor.dtype(), tensor.shape());
        return Err(FormatError::TensorShape {
            name: name.to_owned(),
            got,
            expected: format!("F32 {shape:?}"),
        });
    }
    let (words, _) = tensor.data().as_chunks::<4>();
    Ok(words.iter().map(|word| f32::from_le_bytes(*word)).collect())
}

fn refuse_unknown_tensors(file: &SafeTensors<'_>, policy: &Policy) -> Result<(), FormatError> {
    let known: Vec<String> = policy.tensors().into_iter().map(|tensor| tensor.name).collect();
    let mut names = file.names();
    names.sort_unstable();
    match names.into_iter().find(|name| !known.iter().any(|known| known == name)) {
        Some(name) => Err(FormatError::UnknownTensor { name: name.to_owned() }),
        None => Ok(()),
    }
}

/// Writes beside `path` and renames, so that `path` is always a whole file, old or new.
fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let file_name = path.file_name().ok_or(io::ErrorKind::InvalidFilename)?;
    let mut temporary_name = file_name.to_owned();
    temporary_name.push(format!(".{}.tmp", std::process::id()));
    let temporary: PathBuf = path.with_file_name(temporary_name);
    let written = File::create(&temporary)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| fs::rename(&temporary, path));
    if written.is_err() {
        drop(fs::remove_file(&temporary));
    }
    written
}

#[cfg(test)]
mod tests {
    use std::error::Error as _;

    use super::*;

    fn sample() -> Policy {
        Policy::sample(Layout::new(Task::Push, 2), 2)
    }

    /// The file's bytes with a header that `edit` has changed.
    fn with_header(bytes: &[u8], edit: impl FnOnce(&mut Map<String, Value>)) -> Vec<u8> {
        let (length, rest) = bytes.split_first_chunk::<8>().unwrap();
        let (header, data) = rest.split_at(usize::try_from(u64::from_le_bytes(*length)).unwrap());
        let mut header: Map<String, Value> = serde_json::from_slice(header).unwrap();
        edit(&mut header);
        let header = Value::Object(header).to_string().into_bytes();
        [&(header.len() as u64).to_le_bytes(), header.as_slice(), data].concat()
    }

    fn with_metadata(bytes: &[u8], key: &str, value: Option<&str>) -> Vec<u8> {
        with_header(bytes, |header| {
            let metadata = header["__metadata__"].as_object_mut().unwrap();
            match value {
                Some(value) => drop(metadata.insert(key.to_owned(), value.into())),
                None => drop(metadata.shift_remove(key)),
            }
        })
    }

    #[test]
    fn a_policy_comes_back_as_it_was_saved() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("policy.safetensors");
        let policy = sample();
        policy.save(&path).unwrap();
        let loaded = Policy::load(&path).unwrap();
        assert_eq!(loaded, policy);
        assert_eq!(loaded.digest(), policy.digest());
        assert_eq!(fs::read(&path).unwrap(), encode(&loaded), "the same bytes again");
        let files: Vec<_> = fs::read_dir(directory.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name())
            .collect();
        assert_eq!(files, ["policy.safetensors"], "nothing else is left behind");
    }

    #[test]
    fn every_number_enters_the_digest() {
        let policy = sample();
        let check = |change: fn(&mut Policy)| {
            let mut changed = policy.clone();
            change(&mut changed);
            assert_ne!(changed.digest(), policy.digest());
        };
        check(|policy| policy.actor[0] += 1.0);
        check(|policy| *policy.critic.last_mut().unwrap() += 1.0);
        check(|policy| policy.observation_normalizer.std[5] += 1.0);
        check(|policy| policy.goal_normalizer.mean[0] += 1.0);
    }

    #[test]
    fn a_policy_that_cannot_be_used_is_not_saved_over_one_that_can() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("policy.safetensors");
        let policy = sample();
        policy.save(&path).unwrap();
        let mut broken = policy.clone();
        broken.critic[3] = f32::INFINITY;
        assert!(matches!(broken.save(&path), Err(Error::NotFinite { name: "critic" })));
        assert_eq!(Policy::load(&path).unwrap(), policy);
        let nowhere = directory.path().join("missing").join("policy.safetensors");
        assert!(matches!(policy.save(&nowhere), Err(Error::Write { .. })));
        assert!(matches!(policy.save(Path::new("/")), Err(Error::Write { .. })));
    }

    #[test]
    fn files_that_are_no_policy_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("policy.safetensors");
        assert!(matches!(Policy::load(&path), Err(Error::Read { .. })), "no such file");
        assert!(matches!(Policy::load(directory.path()), Err(Error::Read { .. })), "a directory");
        let whole = encode(&sample());
        for bytes in
            [&[][..], b"not a policy at all", &whole[..9], &whole[..500], &whole[..whole.len() - 1]]
        {
            fs::write(&path, bytes).unwrap();
            let error = Policy::load(&path).expect_err("must be refused");
            assert!(error.to_string().contains("policy.safetensors"), "{error}");
            let reason = error.source().unwrap().to_string();
            assert_eq!(reason, "not a whole safetensors file", "{} bytes", bytes.len());
        }
        assert!(decode(&[whole.as_slice(), &[0]].concat()).is_err(), "a byte too many");
    }

    #[test]
    fn metadata_that_does_not_match_is_refused() {
        let whole = encode(&sample());
        let check = |key, value, expected: &str| {
            let error = decode(&with_metadata(&whole, key, value)).expect_err("must be refused");
            assert_eq!(error.to_string(), expected);
        };
        check(
            "format",
            Some("tandem-poems"),
            r#"metadata "format" is "tandem-poems", expected "tandem-policy""#,
        );
        check("format", None, r#"metadata "format" is missing"#);
        check("format_version", Some("2"), r#"metadata "format_version" is "2", expected "1""#);
        check(
            "task",
            Some("juggle"),
            r#"metadata "task" is "juggle", expected push or pick-and-place"#,
        );
        check("n_hidden", Some("-1"), r#"metadata "n_hidden" is "-1", expected 1 to 16384"#);
        check("n_hidden_layers", None, r#"metadata "n_hidden_layers" is missing"#);
        check("n_observation", Some("55"), r#"metadata "n_observation" is "55", expected 56"#);
        check("activation", Some("gelu"), r#"metadata "activation" is "gelu", expected relu"#);
        check("normalizer_clip", None, r#"metadata "normalizer_clip" is missing"#);
    }

    #[test]
    fn sizes_that_the_tensors_do_not_have_are_refused() {
        let whole = encode(&sample());
        let check = |key, value, expected: &str| {
            let error =
                decode(&with_metadata(&whole, key, Some(value))).expect_err("must be refused");
            assert_eq!(error.to_string(), expected);
        };
        let weight = r#"tensor "actor.layers.0.weight" is F32 [32, 62], expected"#;
        check("n_arms", "1", &format!("{weight} F32 [32, 31]"));
        check("n_arms", "64", &format!("{weight} F32 [32, 1984]"));
        check("n_hidden", "16", &format!("{weight} F32 [16, 62]"));
        check(
            "task",
            "pick-and-place",
            r#"tensor "actor.layers.2.weight" is F32 [6, 32], expected F32 [8, 32]"#,
        );
        check(
            "n_heads",
            "1",
            r#"tensor "critic.0.layers.2.weight" is F32 [2, 32], expected F32 [1, 32]"#,
        );
        check(
            "n_hidden_layers",
            "3",
            r#"tensor "actor.layers.2.weight" is F32 [6, 32], expected F32 [32, 32]"#,
        );
    }

    #[test]
    fn tensors_that_are_not_as_expected_are_refused() {
        let whole = encode(&sample());
        let check = |edit: fn(&mut Map<String, Value>), expected: &str| {
            let error = decode(&with_header(&whole, edit)).expect_err("must be refused");
            assert_eq!(error.to_string(), expected);
        };
        let rename = |header: &mut Map<String, Value>| {
            let tensor = header.shift_remove("normalizer.goal.std").unwrap();
            header.insert("normalizer.goal.sigma".to_owned(), tensor);
        };
        check(rename, r#"tensor "normalizer.goal.std" is missing"#);
        let transpose = |header: &mut Map<String, Value>| {
            header["critic.0.layers.0.weight"]["shape"] = json!([68, 32])
        };
        check(
            transpose,
            r#"tensor "critic.0.layers.0.weight" is F32 [68, 32], expected F32 [32, 68]"#,
        );
        let retype =
            |header: &mut Map<String, Value>| header["actor.layers.0.bias"]["dtype"] = json!("I32");
        check(retype, r#"tensor "actor.layers.0.bias" is I32 [32], expected F32 [32]"#);
        let add = |header: &mut Map<String, Value>| {
            let end = header["normalizer.goal.std"]["data_offsets"][1].clone();
            let tensor = json!({ "dtype": "F32", "shape": [0], "data_offsets": [end, end] });
            header.insert("actor.norm.0.weight".to_owned(), tensor);
        };
        check(add, r#"tensor "actor.norm.0.weight" is unknown"#);
    }

    #[test]
    fn numbers_that_cannot_be_used_or_were_altered_are_refused() {
        let check = |change: fn(&mut Policy), expected: &str| {
            let mut policy = sample();
            change(&mut policy);
            assert_eq!(
                decode(&encode(&policy)).expect_err("must be refused").to_string(),
                expected
            );
        };
        check(|policy| policy.actor[9] = f32::NAN, "actor holds a number that is not finite");
        check(
            |policy| policy.goal_normalizer.mean[0] = f32::INFINITY,
            "goal mean holds a number that is not finite",
        );
        check(
            |policy| policy.goal_normalizer.std[2] = -0.1,
            "goal std holds a number that is not above 0",
        );

        let mut altered = encode(&sample());
        *altered.last_mut().unwrap() ^= 1;
        assert!(matches!(decode(&altered), Err(FormatError::Digest { .. })));
        let undigested = with_metadata(&altered, "digest", None);
        assert!(decode(&undigested).is_ok(), "a file that another program wrote");
    }
}
