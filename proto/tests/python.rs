//! The Python client's generated modules say the same as the definitions that they were made from.

#![allow(clippy::unwrap_used, reason = "tests")]

use prost::Message;
use prost_types::{DescriptorProto, FileDescriptorProto, FileDescriptorSet};
use std::path::Path;

/// The bytes of a Python bytes literal, without its quotes.
fn unescape(literal: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut rest = literal.bytes();
    while let Some(byte) = rest.next() {
        if byte != b'\\' {
            bytes.push(byte);
            continue;
        }
        match rest.next().unwrap() {
            b'n' => bytes.push(b'\n'),
            b't' => bytes.push(b'\t'),
            b'r' => bytes.push(b'\r'),
            b'x' => {
                let digits = [rest.next().unwrap(), rest.next().unwrap()];
                bytes.push(u8::from_str_radix(std::str::from_utf8(&digits).unwrap(), 16).unwrap());
            }
            quoted => bytes.push(quoted),
        }
    }
    bytes
}

/// The descriptor that a generated module carries.
fn of_python(name: &str) -> FileDescriptorProto {
    let module = name.replace(".proto", "_pb2.py");
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../client/python")
        .join(module);
    let text = std::fs::read_to_string(path).unwrap();
    let literal = text.split("AddSerializedFile(b'").nth(1).unwrap();
    let literal = literal.split("')\n").next().unwrap();
    FileDescriptorProto::decode(unescape(literal).as_slice()).unwrap()
}

/// Takes away what the two compilers fill in differently, and what follows from the rest.
fn plain(mut file: FileDescriptorProto) -> FileDescriptorProto {
    fn forget(message: &mut DescriptorProto) {
        message.field.iter_mut().for_each(|field| field.json_name = None);
        message.nested_type.iter_mut().for_each(forget);
    }
    file.source_code_info = None;
    file.message_type.iter_mut().for_each(forget);
    file
}

#[test]
fn generated_python_modules_are_up_to_date() {
    let set = FileDescriptorSet::decode(pbgi_proto::FILE_DESCRIPTOR_SET).unwrap();
    for name in ["pbgi/v1/types.proto", "pbgi/v1/jobs.proto"] {
        let ours = set.file.iter().find(|file| file.name() == name).unwrap();
        assert!(
            plain(ours.clone()) == plain(of_python(name)),
            "client/python/pbgi/v1 is older than {name}: run python3 client/python/tests/generate.py (needs grpcio-tools)"
        );
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../client/python/pbgi/v1/jobs_pb2_grpc.py");
    let stubs = std::fs::read_to_string(path).unwrap();
    let services = set.file.iter().filter(|file| file.name() == "pbgi/v1/jobs.proto");
    for service in services.flat_map(|file| &file.service) {
        for method in &service.method {
            let call = format!("/pbgi.v1.{}/{}'", service.name(), method.name());
            assert!(stubs.contains(&call), "jobs_pb2_grpc.py does not know {call}");
        }
    }
}
