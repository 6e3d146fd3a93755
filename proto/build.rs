//! Compiles the protobuf definitions in Rust (no `protoc`), and keeps the descriptor set for reflection.

use std::path::PathBuf;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let files = ["pbgi/v1/types.proto", "pbgi/v1/jobs.proto", "pbgi/v1/queue.proto"];
    for file in files {
        println!("cargo:rerun-if-changed={file}");
    }
    let descriptors = protox::compile(files, ["."])?;
    let out = PathBuf::from(std::env::var("OUT_DIR")?).join("pbgi.v1.descriptors");
    tonic_prost_build::configure()
        .file_descriptor_set_path(&out)
        .compile_fds(descriptors.clone())?;
    std::fs::write(out, prost::Message::encode_to_vec(&descriptors))?;
    Ok(())
}
