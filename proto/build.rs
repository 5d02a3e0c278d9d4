//! Compiles the protocol without an installed `protoc`.

use std::error::Error;
use std::path::PathBuf;

use prost::Message as _;

/// The type of fields that are messages, in descriptors.
const TYPE_MESSAGE: i32 = 11;
const PACKAGE: &str = ".tandem.v1.";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let files = protox::compile(
        [
            "tandem/v1/bridge.proto",
            "tandem/v1/environment.proto",
            "tandem/v1/learner.proto",
            "tandem/v1/policy.proto",
            "tandem/v1/task.proto",
            "tandem/v1/teacher.proto",
        ],
        ["proto"],
    )?;
    let out = PathBuf::from(std::env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?);
    std::fs::write(out.join("tandem_descriptor.bin"), files.encode_to_vec())?;
    let mut message_fields = String::new();
    for message in files.file.iter().flat_map(|file| &file.message_type) {
        let of_messages = message.field.iter().filter(|field| field.r#type == Some(TYPE_MESSAGE));
        let fields: Vec<(i32, &str)> = of_messages
            .map(|field| (field.number(), field.type_name().trim_start_matches(PACKAGE)))
            .collect();
        message_fields.push_str(&message_fields_of(message.name(), &fields));
    }
    std::fs::write(out.join("message_fields.rs"), message_fields)?;
    tonic_prost_build::configure().build_server(false).compile_fds(files.clone())?;
    // Servers and clients report malformed messages with different status codes, so servers have a codec of their own.
    let servers = out.join("servers");
    std::fs::create_dir_all(&servers)?;
    tonic_prost_build::configure()
        .build_client(false)
        .codec_path("crate::codec::RequestCodec")
        .extern_path(".tandem.v1", "crate::pb")
        .out_dir(servers)
        .compile_fds(files)?;
    Ok(())
}

/// Returns the implementation of `MessageFields` for the message `name`. `fields` are the tags and the types of its
/// fields that are messages.
fn message_fields_of(name: &str, fields: &[(i32, &str)]) -> String {
    if fields.is_empty() {
        return format!("impl MessageFields for pb::{name} {{}}\n");
    }
    let arm = |(tag, of): &(i32, &str)| format!("{tag} => count_messages::<pb::{of}>, ");
    let arms: String = fields.iter().map(arm).collect();
    format!(
        "impl MessageFields for pb::{name} {{ fn counter(tag: u32) -> Option<Counter> \
         {{ Some(match tag {{ {arms}_ => return None }}) }} }}\n"
    )
}
