"""The other side of tests/openexr.rs: files written and read by the reference implementation (PyPI: OpenEXR, numpy).

exchange.py write FOLDER   writes G-buffers in the forms that renderers and compositing programs use
exchange.py read FILE      prints what a file holds, as JSON
exchange.py same A B       fails unless the Cryptomatte channels and the attributes of A are in B, bit for bit
"""

import json
import sys

import numpy as np
import OpenEXR

WIDTH, HEIGHT = 70, 45
# Not the picture's: overscan on the left and above, a crop on the right and below.
ORIGIN = (-5, -3)
DISPLAY = (80, 50)


def window(x, y, width, height):
    return (np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32))


def passes(half_normal=False):
    """Positions that name their pixels, normals up, a hole of each kind."""
    row, column = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    position = [column + 0.5, row * 0.25, column * row + 1.0]
    normal = [np.zeros_like(row), np.ones_like(row), np.zeros_like(row)]
    position[1][1, 1] = np.nan
    position[0][2, 2] = np.inf
    normal[1][3, 3] = 0.0
    if half_normal:
        normal = [axis.astype(np.float16) for axis in normal]
    return position, normal


def named(layers, suffixes):
    return {
        f"{name}.{suffix}" if name else suffix: axis
        for name, layer in layers.items()
        for suffix, axis in zip(suffixes, layer)
    }


def header(**more):
    return {"dataWindow": window(*ORIGIN, WIDTH, HEIGHT), "displayWindow": window(0, 0, *DISPLAY), **more}


def cryptomatte():
    """Ids are any 32 bits that are a usual float; nothing may round them."""
    bits = np.arange(WIDTH * HEIGHT * 4, dtype=np.uint32).reshape(4, HEIGHT, WIDTH) * np.uint32(2654435761)
    exponent = (bits >> 23) & 0xFF
    bits = np.where((exponent == 0) | (exponent == 255), bits ^ (1 << 23), bits)
    ranks = {f"CryptoObject00.{suffix}": plane.view(np.float32) for suffix, plane in zip("RGBA", bits)}
    preview = {f"CryptoObject.{suffix}": np.full((HEIGHT, WIDTH), 0.5, np.float16) for suffix in "RGB"}
    return {**ranks, **preview}


ATTRIBUTES = {
    "cryptomatte/3cb6acf/name": "CryptoObject",
    "cryptomatte/3cb6acf/hash": "MurmurHash3_32",
    "cryptomatte/3cb6acf/manifest": '{"bunny":"13851a76","Äste":"00000001"}',
    "owner": "somebody",
    "capDate": "2026:11:25 06:00:00",
    "renderer/frame": 7,
    "renderer/scale": np.array([1.0, 2.0, 3.0], np.float32),
    "chromaticities": (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767),
}


def write(folder):
    position, normal = passes()
    _, half = passes(half_normal=True)
    usual = named({"P": position, "N": normal}, "XYZ")
    scanlines = {"type": OpenEXR.scanlineimage}
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    single = {
        "none": (scanlines, OpenEXR.NO_COMPRESSION, usual),
        "rle": (scanlines, OpenEXR.RLE_COMPRESSION, usual),
        "zips": (scanlines, OpenEXR.ZIPS_COMPRESSION, named({"Pworld": position, "Nworld": half}, "rgb")),
        "zip": (scanlines, OpenEXR.ZIP_COMPRESSION, named({"WP": position, "normals": normal}, "xyz")),
        "piz": (scanlines, OpenEXR.PIZ_COMPRESSION, named({"position": position, "normal": half}, "XYZ")),
        "tiles": (tiles, OpenEXR.ZIP_COMPRESSION, named({"ViewLayer.Position": position, "ViewLayer.Normal": normal}, "XYZ")),
        "tiles_piz": (tiles, OpenEXR.PIZ_COMPRESSION, usual),
    }
    for name, (kind, compression, channels) in single.items():
        OpenEXR.File(header(compression=compression, **kind), channels).write(f"{folder}/{name}.exr")
    beauty = {"R": normal[1], "G": normal[1], "B": normal[1], "A": np.ones((HEIGHT, WIDTH), np.float16)}
    parts = [
        OpenEXR.Part(header(), beauty, "RGBA"),
        OpenEXR.Part(header(), named({"": position}, "XYZ"), "P"),
        OpenEXR.Part(header(**tiles), named({"": normal}, "XYZ"), "N"),
    ]
    OpenEXR.File(parts).write(f"{folder}/parts.exr")
    # Each part cut to what it shows: the normals lack the last ten columns and rows.
    cropped = named({"": [axis[:-10, :-10].copy() for axis in normal]}, "XYZ")
    small = {**header(), "dataWindow": window(*ORIGIN, WIDTH - 10, HEIGHT - 10)}
    parts = [
        OpenEXR.Part(header(), named({"": position}, "XYZ"), "P"),
        OpenEXR.Part(small, cropped, "N"),
    ]
    OpenEXR.File(parts).write(f"{folder}/crops.exr")
    matrices = {
        "worldToCamera": np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [2, 3, 4, 1]], np.float32),
        "worldToNDC": np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, -1], [5, 6, 7, 8]], np.float32),
    }
    everything = {**usual, **cryptomatte(), "id": np.ones((HEIGHT, WIDTH), np.uint32)}
    OpenEXR.File(header(**matrices, **ATTRIBUTES), everything).write(f"{folder}/full.exr")


def plain(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (tuple, list)):
        return [plain(item) for item in value]
    return value if isinstance(value, (int, float, str)) else str(value)


def opened(path):
    return OpenEXR.File(path, separate_channels=True)


def read(path):
    file = opened(path)
    attributes = {key: plain(value) for key, value in file.header().items()}
    channels = {
        name: {"type": str(channel.pixels.dtype), "sum": float(np.sum(channel.pixels, dtype=np.float64))}
        for name, channel in file.channels().items()
    }
    print(json.dumps({"parts": len(file.parts), "attributes": attributes, "channels": channels}))


def same(first, second):
    a, b = opened(first), opened(second)
    cryptos = [name for name in a.channels() if name.startswith("Crypto")]
    assert len(cryptos) == 7, cryptos
    for name in cryptos:
        mine, theirs = a.channels()[name].pixels, b.channels()[name].pixels
        assert mine.dtype == theirs.dtype and mine.tobytes() == theirs.tobytes(), name
    for key in [*ATTRIBUTES, "worldToCamera", "worldToNDC", "dataWindow", "displayWindow"]:
        assert plain(a.header()[key]) == plain(b.header()[key]), (key, a.header()[key], b.header().get(key))
    assert "P.X" not in b.channels() and "id" not in b.channels()


if __name__ == "__main__":
    {"write": write, "read": read, "same": same}[sys.argv[1]](*sys.argv[2:])
