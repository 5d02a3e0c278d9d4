//! Model files.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, ErrorKind, Read as _};
use std::path::Path;

use prost::Message as _;
use sha2::{Digest as _, Sha256};
use tandem_core::text::hex;

use crate::error::{Error, ModelError};
use crate::graph;
use crate::network::Network;
use crate::onnx_proto::ModelProto;
use crate::scan::{self, MAX_FILE_BYTES};

/// Oldest supported version of the operators (2017): `Add` broadcasts as it does today.
const MIN_OPSET: i64 = 7;
/// Newest version of the operators whose changes were reviewed.
const MAX_OPSET: i64 = 25;

/// A model whose graph is a supported network.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// The network.
    pub network: Network,
    /// Free-form entries; [`crate::metadata`] lists those of Tandem.
    pub metadata: BTreeMap<String, String>,
    /// Name and version of the program that wrote the model; possibly empty.
    pub producer: String,
    /// Version of the file format.
    pub ir_version: i64,
    /// Version of the operators.
    pub opset: i64,
    /// SHA-256 of the file, hexadecimal.
    pub digest: String,
}

impl Model {
    /// Reads a model from the file `path`.
    ///
    /// # Errors
    /// When the file cannot be read, is not a regular file, or [`Self::decode`] refuses it.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let file = read(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        Self::decode(&file)
            .map_err(|source| Error::Refused { path: path.to_owned(), source: Box::new(source) })
    }

    /// Decodes a model. The memory that this takes is bounded by a small multiple of the file's size.
    ///
    /// # Errors
    /// When `file` is malformed or too large, or its graph has an unsupported operator, shape or number.
    pub fn decode(file: &[u8]) -> Result<Self, ModelError> {
        scan::check(file)?;
        let model = ModelProto::decode(file).map_err(|_malformed| ModelError::NotOnnx)?;
        let opset = opset(&model)?;
        let graph = model.graph.as_ref();
        let graph = graph.ok_or_else(|| ModelError::Model("it has no graph".to_owned()))?;
        let network = graph::network(graph, opset, file.len())?;
        let producer = format!("{} {}", model.producer_name, model.producer_version);
        let entries = model.metadata_props.into_iter().map(|entry| (entry.key, entry.value));
        Ok(Self {
            network,
            metadata: entries.collect(),
            producer: producer.trim().to_owned(),
            ir_version: model.ir_version,
            opset,
            digest: digest(file),
        })
    }
}

/// Returns the digest of a model's file: its SHA-256, hexadecimal.
#[must_use]
pub fn digest(file: &[u8]) -> String {
    hex(&Sha256::digest(file))
}

/// Returns the SHA-256, hexadecimal, over the digests of several files.
#[must_use]
pub fn digest_of(digests: &[&str]) -> String {
    let mut hasher = Sha256::new();
    digests.iter().for_each(|digest| hasher.update(digest.as_bytes()));
    hex(&hasher.finalize())
}

/// Returns the version of the standard operators.
fn opset(model: &ModelProto) -> Result<i64, ModelError> {
    let standard = |domain: &str| domain.is_empty() || domain == "ai.onnx";
    let versions = model.opset_import.iter().filter(|opset| standard(&opset.domain));
    let version = versions.map(|opset| opset.version).max().unwrap_or_default();
    if (MIN_OPSET..=MAX_OPSET).contains(&version) {
        return Ok(version);
    }
    Err(ModelError::Model(format!(
        "it uses version {version} of the operators (opset), expected {MIN_OPSET} to {MAX_OPSET}"
    )))
}

/// Reads a regular file, at most one byte more than a model can have. Pipes and devices are refused: they may never end.
fn read(path: &Path) -> io::Result<Vec<u8>> {
    let file = std::fs::metadata(path)?;
    if !file.is_file() && !file.is_dir() {
        return Err(io::Error::new(ErrorKind::InvalidInput, "it is not a regular file"));
    }
    let mut bytes = Vec::new();
    File::open(path)?.take(MAX_FILE_BYTES as u64 + 1).read_to_end(&mut bytes)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests;
