"""A light meter: what a built scene's light does along a line of points.

    pbgi-client build docs/examples/court.toml -o court.pbgi --points 300000
    python3 docs/examples/points.py court.pbgi --from -2.6,0.01,1.5 --to 2.6,0.01,1.5

needs the Python client (`pip install ./client/python`) and a daemon: the private one that `build` left, or --server. The points face
up unless --normal says otherwise. Nothing is drawn: the table goes to standard output.
"""

import argparse
import json
import pathlib
import subprocess

import numpy as np

import pbgi


def vector(text: str) -> np.ndarray:
    values = np.array([float(part) for part in text.split(",")], np.float32)
    if values.shape != (3,):
        raise argparse.ArgumentTypeError(f"{text!r} is no X,Y,Z")
    return values


def private_daemon() -> str:
    """The address of a daemon of this user; `pbgi-client` knows where they are."""
    told = subprocess.run(["pbgi-client", "status", "--json"], capture_output=True, text=True)
    if told.returncode != 0:
        raise SystemExit(told.stderr.strip())
    return json.loads(told.stdout)[0]["address"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=pathlib.Path)
    parser.add_argument("--from", dest="first", type=vector, required=True, metavar="X,Y,Z")
    parser.add_argument("--to", dest="last", type=vector, required=True, metavar="X,Y,Z")
    parser.add_argument("--normal", type=vector, default=vector("0,1,0"), metavar="X,Y,Z")
    parser.add_argument("--count", type=int, default=9)
    parser.add_argument("--server", help="unix:/path/to/jobs.sock [default: your private daemon]")
    arguments = parser.parse_args()

    share = np.linspace(0, 1, arguments.count, dtype=np.float32)[:, None]
    positions = arguments.first + share * (arguments.last - arguments.first)
    normals = np.broadcast_to(arguments.normal, positions.shape)
    with pbgi.Client(arguments.server or private_daemon()) as client:
        shaded = client.shade_points(str(arguments.scene.resolve()), positions, normals)

    print(f"{'x':>8}{'y':>8}{'z':>8}{'red':>9}{'green':>9}{'blue':>9}{'occlusion':>11}")
    for position, irradiance, occlusion in zip(positions, shaded.irradiance, shaded.occlusion):
        x, y, z = position
        red, green, blue = irradiance
        print(f"{x:8.2f}{y:8.2f}{z:8.2f}{red:9.4f}{green:9.4f}{blue:9.4f}{occlusion:11.3f}")


if __name__ == "__main__":
    main()
