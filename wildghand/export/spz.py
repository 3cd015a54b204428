"""Gaussians as SPZ, version 3: a tenth of a PLY's size, with rounded numbers."""

from __future__ import annotations

import gzip
import math
import struct

import numpy as np

from hwp_bench.base.errors import UsageError
from wildghand.avatar.avatar import PosedGaussians
from wildghand.export.all_round import SH_CONSTANT

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
        splats: in the axes of the format: x right, y up, z back; within 64 units of the origin.
        harmonics: (N, K, 3) of their colours (`wildghand.export.all_round`); None: the colours of
            the Gaussians in every direction. Those of degree 1 and more are cut to [-1, 1].

    Raises:
        UsageError: a coordinate is beyond the format's reach.

    Source: the public description of the format by Niantic (nianticlabs/spz, version 3): gzip of
    16 bytes of header and, one array after the other, positions, opacities, colours, scales,
    rotations and harmonics. The same Gaussians give the same bytes.
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
