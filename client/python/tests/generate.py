"""Writes pbgi/v1 anew from the protobuf definitions. Needs grpcio-tools."""

import pathlib
import sys

from grpc_tools import protoc

HERE = pathlib.Path(__file__).resolve().parent.parent
PROTO = HERE.parent.parent / "proto"


def generate(out: pathlib.Path) -> None:
    files = ["types.proto", "jobs.proto"]
    arguments = ["protoc", f"-I{PROTO}", f"--python_out={out}", f"--grpc_python_out={out}"]
    if protoc.main(arguments + [str(PROTO / "pbgi/v1" / name) for name in files]) != 0:
        sys.exit("the definitions do not compile")
    # Messages without services.
    (out / "pbgi/v1/types_pb2_grpc.py").unlink()


if __name__ == "__main__":
    generate(HERE)
