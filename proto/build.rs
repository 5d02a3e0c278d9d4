//! Compiles the protocol without an installed `protoc`.

use std::error::Error;
use std::path::PathBuf;

use prost::Message as _;

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
