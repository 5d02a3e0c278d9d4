//! The policy file, a safetensors file. `docs/policy-format.md` specifies the format.

use std::collections::BTreeMap;
#[cfg(feature = "files")]
use std::path::Path;

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use serde_json::{Map, Value, json};
use tandem_core::task::MAX_ARMS;
use tandem_core::text::shortened;
use tandem_core::{Layout, Task, TaskDescription, TaskSpec};
#[cfg(feature = "files")]
use tandem_system::{atomic_file, regular_file};

use crate::error::{Error, FormatError};
use crate::mlp::MlpShape;
use crate::normalizer::{CLIP, NormalizerSnapshot};
use crate::policy::{MAX_HEADS, MAX_HIDDEN, MAX_HIDDEN_LAYERS, Policy, little_endian};

#[cfg(test)]
mod tests;

/// Value of the metadata entry `format`.
pub const FORMAT: &str = "tandem-policy";
/// Value of the metadata entry `format_version` in files of built-in tasks.
pub const FORMAT_VERSION: &str = "1";
/// Value of the metadata entry `format_version` in files of other tasks, which contain the task's description. Files of
/// versions other than these two are refused.
pub const DESCRIBED_FORMAT_VERSION: &str = "2";

/// Largest number of characters of a file's entry in an error message. A digest has 64.
const MAX_SHOWN_CHARS: usize = 80;
/// Headers are padded to a multiple of this number of bytes. A header's length precedes it as a little-endian `u64`.
const HEADER_ALIGNMENT: usize = 8;

impl Policy {
    /// Writes the policy to `path` atomically. Needs feature `files`.
    ///
    /// # Errors
    /// Returns an error if the policy is invalid (see [`Policy::check`]) or the file cannot be written.
    #[cfg(feature = "files")]
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        atomic_file::replace(path, &self.to_bytes()?)
            .map_err(|source| Error::Write { path: path.to_owned(), source })
    }

    /// Reads a policy from `path`. Needs feature `files`.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read, was truncated or altered, has another format or version, or if a
    /// tensor does not match the task, the number of arms and the networks' sizes.
    #[cfg(feature = "files")]
    pub fn load(path: &Path) -> Result<Self, Error> {
        let bytes = regular_file::read(path)
            .map_err(|source| Error::Read { path: path.to_owned(), source })?;
        Self::from_bytes(&bytes)
            .map_err(|source| Error::Refused { path: path.to_owned(), source: Box::new(source) })
    }

    /// Returns the contents of the policy's file. Equal policies give equal bytes.
    ///
    /// # Errors
    /// Returns an error if the policy is invalid (see [`Policy::check`]).
    pub fn to_bytes(&self) -> Result<Vec<u8>, Error> {
        self.check()?;
        Ok(encode(self))
    }

    /// Reads a policy from the contents of a file.
    ///
    /// # Errors
    /// Returns an error if the contents were truncated or altered, have another format or version, or if a tensor does
    /// not match the task, the number of arms and the networks' sizes.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, FormatError> {
        decode(bytes)
    }
}

/// Encodes a policy file. Equal policies give equal bytes.
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

/// Returns the policy's own metadata and the entries that the format defines.
fn metadata(policy: &Policy) -> BTreeMap<String, String> {
    let mut metadata = policy.metadata.clone();
    metadata.extend(reserved(policy).into_iter().map(|(key, value)| (key.to_owned(), value)));
    metadata
}

/// Returns the entries that the format defines, in the order in which a reader checks them.
fn reserved(policy: &Policy) -> Vec<(&'static str, String)> {
    let task = &policy.task;
    let description = task.as_built_in().is_none().then(|| description_entry(task));
    let version = if description.is_some() { DESCRIBED_FORMAT_VERSION } else { FORMAT_VERSION };
    let entries = [
        ("format", FORMAT.to_owned()),
        ("format_version", version.to_owned()),
        ("task", task.name().to_owned()),
        ("n_arms", task.n_arms().to_string()),
        ("n_hidden", policy.n_hidden.to_string()),
        ("n_hidden_layers", policy.n_hidden_layers.to_string()),
        ("n_heads", policy.n_heads.to_string()),
        ("n_observation", task.n_observation().to_string()),
        ("n_goal", task.n_goal().to_string()),
        ("n_action", task.n_action().to_string()),
        ("activation", "relu".to_owned()),
        ("output_activation", "tanh".to_owned()),
        ("action_clip", "1".to_owned()),
        ("normalizer_clip", CLIP.to_string()),
        ("digest", policy.digest()),
    ];
    entries.into_iter().chain(description.map(|text| ("description", text))).collect()
}

fn description_entry(task: &TaskSpec) -> String {
    json!(task.description()).to_string()
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

/// Reads sizes and tensors. Every tensor must have the shape that follows from the sizes.
fn read_policy(
    file: &SafeTensors<'_>,
    metadata: BTreeMap<String, String>,
) -> Result<Policy, FormatError> {
    expect_entry(&metadata, "format", FORMAT)?;
    let task = match entry(&metadata, "format_version")? {
        DESCRIBED_FORMAT_VERSION => parse_description(&metadata)?,
        FORMAT_VERSION => {
            let task = parse_task(&metadata)?;
            Layout::new(task, parse_size(&metadata, "n_arms", MAX_ARMS)?).into()
        }
        got => {
            return Err(FormatError::Metadata {
                key: "format_version",
                got: shortened(got, MAX_SHOWN_CHARS),
                expected: format!("{FORMAT_VERSION:?} or {DESCRIBED_FORMAT_VERSION:?}"),
            });
        }
    };
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
        n_hidden,
        n_hidden_layers,
        n_heads,
        actor: read_network(file, "actor", &MlpShape::actor(&task, n_hidden, n_hidden_layers))?,
        critic: read_network(
            file,
            "critic.0",
            &MlpShape::critic(&task, n_hidden, n_hidden_layers, n_heads),
        )?,
        observation_normalizer: normalizer("observation", task.n_observation())?,
        goal_normalizer: normalizer("goal", task.n_goal())?,
        task,
        metadata,
    })
}

/// Compares the entries that the format defines with those that this version writes for the same tensors, and removes
/// them from the policy's metadata. The digest may be missing, as in files of other programs.
fn check_reserved(mut policy: Policy) -> Result<Policy, FormatError> {
    for (key, expected) in reserved(&policy) {
        match (key, policy.metadata.remove(key)) {
            (_, Some(got)) if got == expected => {}
            // The description was read; another program may have written the same numbers differently.
            ("digest", None) | ("description", Some(_)) => {}
            ("digest", Some(written)) => {
                return Err(FormatError::Digest {
                    got: expected,
                    expected: shortened(&written, MAX_SHOWN_CHARS),
                });
            }
            (_, Some(got)) => {
                return Err(FormatError::Metadata {
                    key,
                    got: shortened(&got, MAX_SHOWN_CHARS),
                    expected,
                });
            }
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
    Err(FormatError::Metadata {
        key,
        got: shortened(got, MAX_SHOWN_CHARS),
        expected: format!("{expected:?}"),
    })
}

/// Reads the description of a task that is not built-in.
fn parse_description(metadata: &BTreeMap<String, String>) -> Result<TaskSpec, FormatError> {
    let text = entry(metadata, "description")?;
    let refusal = |problem: String| FormatError::Metadata {
        key: "description",
        got: shortened(text, MAX_SHOWN_CHARS),
        expected: format!("the description of a task: {problem}"),
    };
    let description: TaskDescription =
        serde_json::from_str(text).map_err(|error| refusal(error.to_string()))?;
    let task = TaskSpec::new(description).map_err(|error| refusal(error.to_string()))?;
    match task.as_built_in() {
        None => Ok(task),
        Some(_) => Err(refusal(format!("{} is built-in, which is version 1", task.name()))),
    }
}

fn parse_task(metadata: &BTreeMap<String, String>) -> Result<Task, FormatError> {
    let got = entry(metadata, "task")?;
    let expected = || format!("one of {}", Task::ALL.map(Task::name).join(", "));
    let refusal = |_unknown| FormatError::Metadata {
        key: "task",
        got: shortened(got, MAX_SHOWN_CHARS),
        expected: expected(),
    };
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
            got: shortened(got, MAX_SHOWN_CHARS),
            expected: format!("1 to {most}"),
        }),
    }
}

/// Reads a network's parameters, the concatenation of its tensors.
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
        Some(name) => Err(FormatError::UnknownTensor { name: shortened(name, MAX_SHOWN_CHARS) }),
        None => Ok(()),
    }
}
