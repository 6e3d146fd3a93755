"""What Mitsuba 3 sees of a glTF scene, as passes for pbgi: its own direct light, positions, normals, albedo.

    pip install mitsuba numpy
    python3 docs/examples/mitsuba_passes.py docs/examples/cornell.glb passes.exr --size 96

reads meshes with base colours, one point light and one camera, all at the root: enough for a box, and short enough to be read. Mitsuba has no
glTF reader; a production renderer would have one, and would write such passes without any of this.
"""

import argparse
import json
import pathlib
import struct
import tempfile

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")

COMPONENTS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
LANES = {"SCALAR": 1, "VEC3": 3}


class Glb:
    """The text and the numbers of a GLB file."""

    def __init__(self, path: pathlib.Path):
        data = path.read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        self.text = json.loads(data[20 : 20 + length])
        self.binary = data[20 + length + 8 :]

    def numbers(self, index: int) -> np.ndarray:
        accessor = self.text["accessors"][index]
        view = self.text["bufferViews"][accessor["bufferView"]]
        lanes = LANES[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        flat = np.frombuffer(self.binary, COMPONENTS[accessor["componentType"]], accessor["count"] * lanes, start)
        return flat.reshape(-1, lanes)

    def nodes(self):
        """The nodes of the scene with their places in the world; one below another is not looked for."""
        for index in self.text["scenes"][0]["nodes"]:
            node = self.text["nodes"][index]
            yield node, np.array(node.get("matrix", np.eye(4).ravel()), float).reshape(4, 4).T


def shapes(glb: Glb, mesh: dict, world: np.ndarray, folder: pathlib.Path, name: str) -> dict:
    """The primitives of a mesh, through OBJ files: diffuse, seen and lit from both sides."""
    found = {}
    for index, primitive in enumerate(mesh["primitives"]):
        points = glb.numbers(primitive["attributes"]["POSITION"]) @ world[:3, :3].T + world[:3, 3]
        corners = glb.numbers(primitive["indices"]) if "indices" in primitive else np.arange(len(points))
        path = folder / f"{name}_{index}.obj"
        lines = [f"v {x} {y} {z}" for x, y, z in points]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in corners.reshape(-1, 3).astype(int)]
        path.write_text("\n".join(lines) + "\n")
        material = glb.text["materials"][primitive["material"]]
        albedo = material["pbrMetallicRoughness"].get("baseColorFactor", [1, 1, 1])[:3]
        diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}
        found[f"{name}_{index}"] = {
            "type": "obj",
            "filename": str(path),
            "face_normals": True,
            "bsdf": {"type": "twosided", "inner": diffuse},
        }
    return found


def scene(glb: Glb, size: int, folder: pathlib.Path) -> dict:
    told = {
        "type": "scene",
        # The picture is what one light does without any bounce; the rest is what pbgi adds.
        "integrator": {"type": "aov", "aovs": "P:position,N:sh_normal,albedo:albedo", "image": {"type": "direct"}},
    }
    for number, (node, world) in enumerate(glb.nodes()):
        if "mesh" in node:
            told |= shapes(glb, glb.text["meshes"][node["mesh"]], world, folder, f"mesh_{number}")
        light = node.get("extensions", {}).get("KHR_lights_punctual")
        if light is not None:
            light = glb.text["extensions"]["KHR_lights_punctual"]["lights"][light["light"]]
            intensity = [light.get("intensity", 1.0) * c for c in light.get("color", [1, 1, 1])]
            told["light"] = {
                "type": "point",
                "position": [float(c) for c in world[:3, 3]],
                "intensity": {"type": "rgb", "value": intensity},
            }
        if "camera" in node:
            camera = glb.text["cameras"][node["camera"]]["perspective"]
            # glTF looks along -z, Mitsuba along +z.
            turned = world @ np.diag([-1.0, 1.0, -1.0, 1.0])
            told["sensor"] = {
                "type": "perspective",
                "fov_axis": "y",
                "fov": float(np.degrees(camera["yfov"])),
                "to_world": mi.ScalarTransform4f(turned),
                # One ray through the middle of each pixel: a mean of two positions is a place where nothing is.
                "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
                "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "rfilter": {"type": "box"}},
            }
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=pathlib.Path)
    parser.add_argument("output")
    parser.add_argument("--size", type=int, default=96)
    arguments = parser.parse_args()

    glb = Glb(arguments.scene)
    with tempfile.TemporaryDirectory() as folder:
        loaded = mi.load_dict(scene(glb, arguments.size, pathlib.Path(folder)))
        image = mi.render(loaded, spp=1)
    names = ["R", "G", "B", "A", *(f"{n}.{s}" for n in "PN" for s in "XYZ"), *(f"albedo.{c}" for c in "RGB")]
    values = np.array(image)
    # Normals as the mesh has them may face away from the camera; the side that is seen is the one to be lit.
    eye = next(world[:3, 3] for node, world in glb.nodes() if "camera" in node)
    position, normal = values[..., 4:7], values[..., 7:10]
    away = np.sum((eye - position) * normal, axis=-1, keepdims=True) < 0
    values[..., 7:10] = np.where(away, -normal, normal)
    bitmap = mi.Bitmap(values.astype(np.float32), channel_names=names)
    bitmap.write(arguments.output)


if __name__ == "__main__":
    main()
