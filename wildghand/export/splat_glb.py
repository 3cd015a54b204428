"""Gaussians as binary glTF with `KHR_gaussian_splatting`, a release candidate of Khronos."""

from __future__ import annotations

import math

import numpy as np

from wildghand.avatar.avatar import PosedGaussians
from wildghand.export.all_round import SH_CONSTANT
from wildghand.export.glb import ATTRIBUTES, GlbBuilder

#: Name of the extension.
EXTENSION = "KHR_gaussian_splatting"


def splat_glb_bytes(
    splats: PosedGaussians, generator: str, harmonics: np.ndarray | None = None
) -> bytes:
    """Return N Gaussians as one primitive of points.

    Programs that do not know the extension show coloured points.

    Args:
        splats: in glTF's axes: y up, z back.
        generator: the program that writes it.
        harmonics: (N, K, 3) of their colours (`wildghand.export.all_round`); None: the colours of
            the Gaussians in every direction.

    Source: Khronos, KHR_gaussian_splatting, release candidate of 2026: the kernel `ellipse`,
    display-referred sRGB, quaternions (x, y, z, w), scales and opacities as they are.
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
