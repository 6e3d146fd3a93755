"""A renderer's picture with the indirect light that pbgi found for it: RGB + albedo / pi * indirect.

    pip install OpenEXR numpy
    python3 docs/examples/composite.py passes.exr indirect.exr beauty.exr

takes the direct light (R, G, B) and `albedo` of the passes and `indirect`, `occlusion` and `A` of what `shade` wrote, and
writes one part with the names that Nuke shows as layers: rgba, albedo, direct, indirect, occlusion.
"""

import sys

import numpy as np
import OpenEXR


def layer(channels: dict, name: str) -> np.ndarray:
    prefix = f"{name}." if name else ""
    return np.stack([channels[prefix + c].pixels.astype(np.float32) for c in "RGB"], axis=-1)


def main() -> None:
    if len(sys.argv) != 4:
        raise SystemExit(__doc__)
    passes, shaded = (OpenEXR.File(path, separate_channels=True) for path in sys.argv[1:3])
    header = passes.header()
    for window in ("dataWindow", "displayWindow"):
        if np.any(np.array(header[window]) != np.array(shaded.header()[window])):
            raise SystemExit(f"{sys.argv[1]} and {sys.argv[2]} differ in their {window}")
    direct, albedo = layer(passes.channels(), ""), layer(passes.channels(), "albedo")
    indirect = layer(shaded.channels(), "indirect")
    layers = {"": direct + albedo / np.pi * indirect, "albedo": albedo, "direct": direct, "indirect": indirect}
    written = {
        f"{name}.{c}" if name else c: np.ascontiguousarray(values[..., axis]).astype(np.float16)
        for name, values in layers.items()
        for axis, c in enumerate("RGB")
    }
    for name in ("A", "occlusion.Z"):
        written[name] = shaded.channels()[name].pixels.astype(np.float16)
    kept = {key: header[key] for key in ("dataWindow", "displayWindow")}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **kept}, written).write(sys.argv[3])


if __name__ == "__main__":
    main()
