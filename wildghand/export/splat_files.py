"""Files of Gaussians: PLY of 3DGS, SPZ, and glTF with `KHR_gaussian_splatting`."""

from __future__ import annotations

import gzip
import json
import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from wildghand.avatar.avatar import PosedGaussians
from wildghand.export.splats import SH_CONSTANT

_TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_COMPONENTS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
#: What a buffer view is for: vertex attributes, indices of corners, or neither.
ATTRIBUTES, INDICES, OTHER = 34962, 34963, None


class GlbBuilder:
    """Collects arrays and JSON of one glTF file.

    Args:
        generator: the program that writes it.

    Attributes:
        content: the JSON, to which the caller adds nodes, meshes and so on.
    """

    def __init__(self, generator: str) -> None:
        asset = {"version": "2.0", "generator": generator}
        self.content: dict[str, Any] = {"asset": asset, "accessors": [], "bufferViews": []}
        self._body = bytearray()

    def array(self, values: np.ndarray, target: int | None = OTHER, *, bounds: bool = False) -> int:
        """Add an array and return the number of its accessor.

        Args:
            values: (N,), (N, 2), (N, 3), (N, 4) or (N, 4, 4) of a type that glTF has; matrices are
                given by rows and kept by columns.
        """
        if not np.isfinite(values).all():
            raise BadInput(
                "holds NaN or infinity, which glTF does not know",
                field=f"array {len(self.content['accessors'])}",
                remedy="The avatar or the motion is damaged; nothing is written.",
            )
        kind = _TYPES[values.shape[1:]]
        flat = values.transpose(0, 2, 1) if kind == "MAT4" else values
        accessor: dict[str, Any] = {
            "bufferView": self._view(np.ascontiguousarray(flat).tobytes(), target),
            "componentType": _COMPONENTS[values.dtype.name],
            "count": len(values),
            "type": kind,
        }
        if bounds:
            rows = values.reshape(len(values), -1)
            accessor["min"] = rows.min(axis=0).tolist()
            accessor["max"] = rows.max(axis=0).tolist()
        self.content["accessors"].append(accessor)
        return len(self.content["accessors"]) - 1

    def image(self, png: bytes) -> int:
        """Add a PNG image and return its number."""
        images = self.content.setdefault("images", [])
        images.append({"bufferView": self._view(png, OTHER), "mimeType": "image/png"})
        return len(images) - 1

    def _view(self, data: bytes, target: int | None) -> int:
        self._body.extend(b"\0" * (-len(self._body) % 4))
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._body), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.content["bufferViews"].append(view)
        self._body.extend(data)
        return len(self.content["bufferViews"]) - 1

    def to_bytes(self) -> bytes:
        """Return the file: a header, a chunk of JSON and a chunk of binary data."""
        content = {**self.content, "buffers": [{"byteLength": len(self._body)}]}
        text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        body = bytes(self._body) + b"\0" * (-len(self._body) % 4)
        length = 12 + 8 + len(text) + 8 + len(body)
        return b"".join(
            (
                struct.pack("<4sII", b"glTF", 2, length),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(body), b"BIN\0"),
                body,
            )
        )


#: Viewers take logits and logarithms: an opacity of 1 or a scale of 0 would be infinite.
OPACITIES = (1e-6, 1.0 - 1e-6)
#: Smallest standard deviation, m.
SMALLEST_SCALE = 1e-12


def ply_bytes(
    splats: PosedGaussians, comments: Sequence[str] = (), harmonics: np.ndarray | None = None
) -> bytes:
    """Return N Gaussians as binary little-endian PLY.

    Args:
        harmonics: (N, K, 3) of their colours (`wildghand.export.splats`); None: the colours of
            the Gaussians in every direction.
    """
    count = len(splats)
    visible = np.clip(splats.opacities, *OPACITIES)
    if harmonics is None:
        harmonics = ((splats.colors - 0.5) / SH_CONSTANT)[:, None]
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (harmonics.shape[1] - 1))
    table = np.concatenate(
        (
            splats.means,
            np.zeros((count, 3)),
            harmonics[:, 0],
            rest,
            np.log(visible / (1.0 - visible))[:, None],
            np.log(np.maximum(splats.scales, SMALLEST_SCALE)),
            splats.quats,
        ),
        axis=1,
    ).astype("<f4")
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{number}" for number in range(rest.shape[1])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header.append(f"element vertex {count}")
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


#: "NGSP", read as a little-endian number, and the version of the format.
MAGIC, VERSION = 0x5053474E, 3
#: Bits of a coordinate behind the point: 24-bit numbers reach +-64 units in steps of 0.01 mm.
FRACTIONAL_BITS = 17
#: A colour's harmonic is kept in steps of 1 / (255 * 0.15).
COLOR_SCALE = 0.15
_LOG_SCALES = (-10.0, 16.0)
_SMALLEST_THREE = 511.0


def spz_bytes(splats: PosedGaussians, harmonics: np.ndarray | None = None) -> bytes:
    """Return N Gaussians as SPZ.

    Args:
        harmonics: (N, K, 3) of their colours (`wildghand.export.splats`); None: the colours of
            the Gaussians in every direction. Those of degree 1 and more are cut to [-1, 1].
    """
    fixed = np.rint(splats.means.astype(np.float64) * 2**FRACTIONAL_BITS)
    if len(fixed) and np.abs(fixed).max() >= 2**23:
        raise UsageError(
            f"a Gaussian lies {np.abs(splats.means).max():.1f} units from the origin",
            field="means",
            remedy=f"SPZ reaches {2 ** (23 - FRACTIONAL_BITS)} units; use a smaller --scale.",
        )
    places = fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[..., :3]
    opacities = _byte(255.0 * splats.opacities)
    if harmonics is None:
        harmonics = ((splats.colors - 0.5) / SH_CONSTANT)[:, None]
    degree = math.isqrt(harmonics.shape[1]) - 1
    colors = _byte(harmonics[:, 0] * (COLOR_SCALE * 255.0) + 127.5)
    others = _byte(harmonics[:, 1:] * 128.0 + 128.0)
    low, steps = _LOG_SCALES
    scales = _byte((np.log(np.maximum(splats.scales, 1e-12)) - low) * steps)
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(splats), degree, FRACTIONAL_BITS, 0, 0)
    arrays = (places, opacities, colors, scales, packed_rotations(splats.quats), others)
    body = header + b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return gzip.compress(body, mtime=0)


def packed_rotations(quats: np.ndarray) -> np.ndarray:
    """Pack unit quaternions: the three smallest components in 10 bits each, and which is missing.

    Args:
        quats: (N, 4), (w, x, y, z).

    Returns:
        (N,) uint32.
    """
    # The format counts components x, y, z, w.
    turned = np.roll(quats.astype(np.float64), -1, axis=1)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    largest = np.abs(turned).argmax(axis=1)
    rows = np.arange(len(turned))
    # A quaternion and its negative are one rotation: the largest component is positive.
    turned *= np.where(turned[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    packed = largest.astype(np.uint32)
    for component in range(4):
        value = turned[:, component]
        size = np.rint(np.abs(value) * np.sqrt(2.0) * _SMALLEST_THREE).clip(0, 511)
        bits = size.astype(np.uint32) | (value < 0.0).astype(np.uint32) << np.uint32(9)
        packed = np.where(component == largest, packed, packed << np.uint32(10) | bits)
    return packed.astype("<u4")


def _byte(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)


#: Name of the extension.
EXTENSION = "KHR_gaussian_splatting"


def splat_glb_bytes(
    splats: PosedGaussians, generator: str, harmonics: np.ndarray | None = None
) -> bytes:
    """Return N Gaussians as one primitive of points.

    Programs that do not know the extension show coloured points.

    Args:
        harmonics: (N, K, 3) of their colours (`wildghand.export.splats`); None: the colours of
            the Gaussians in every direction.
    """
    made = GlbBuilder(generator)
    colors = np.concatenate((splats.colors, splats.opacities[:, None]), axis=1).clip(0.0, 1.0)
    quats = np.roll(splats.quats, -1, axis=1)
    own = {
        "SCALE": splats.scales,
        "ROTATION": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "OPACITY": splats.opacities,
    }
    if harmonics is None:
        harmonics = ((splats.colors - 0.5) / SH_CONSTANT)[:, None]
    for number in range(harmonics.shape[1]):
        degree = math.isqrt(number)
        own[f"SH_DEGREE_{degree}_COEF_{number - degree**2}"] = harmonics[:, number]
    attributes = {
        "POSITION": made.array(splats.means.astype(np.float32), ATTRIBUTES, bounds=True),
        "COLOR_0": made.array(colors.astype(np.float32), ATTRIBUTES),
        **{
            f"{EXTENSION}:{name}": made.array(values.astype(np.float32), ATTRIBUTES)
            for name, values in own.items()
        },
    }
    kernel = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    made.content |= {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "hand"}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: kernel}}
                ]
            }
        ],
    }
    return made.to_bytes()
