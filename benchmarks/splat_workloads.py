"""Hand-like scenes for the rasterizer's benchmark: Gaussians on a palm and five fingers.

The three sizes are those of the study behind the rasterizer: W1 is MANO-HD's vertex count at
512 px, W2 and W3 a quarter and a sixteenth of both. A splat measures one to two pixels, as
after a fit, and the hand fills most of the image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

#: Gaussians and image side of the named workloads.
SIZES = {"W1": (49_281, 512), "W2": (12_337, 256), "W3": (3_093, 128)}
#: Distance of the hand, metres; focal length as a share of the image side.
DISTANCE, FOCAL = 0.4, 1.92
#: Half axes of the palm, metres.
PALM = np.array([0.043, 0.050, 0.014])
#: Fingers: where they start, where they point, length, radius; metres.
FINGERS = (
    ((-0.033, 0.040, 0.0), (-0.012, 1.0, 0.08), 0.070, 0.0095),
    ((-0.011, 0.040, 0.0), (-0.004, 1.0, 0.08), 0.080, 0.0095),
    ((0.011, 0.040, 0.0), (0.004, 1.0, 0.08), 0.074, 0.0095),
    ((0.032, 0.040, 0.0), (0.011, 1.0, 0.08), 0.058, 0.0095),
    ((0.036, -0.012, 0.0), (0.75, 0.66, 0.1), 0.062, 0.0110),
)


@dataclass(frozen=True)
class Workload:
    """Arguments of one call of `rasterize`, float32, one camera."""

    arguments: dict[str, Any]
    size: int

    def views(self, count: int) -> dict[str, torch.Tensor]:
        """The arguments with the camera repeated."""
        cameras = ("viewmats", "Ks", "backgrounds")
        return {
            name: value.expand(count, *value.shape[1:]) if name in cameras else value
            for name, value in self.arguments.items()
        }


def make(count: int, size: int, splat_px: float = 1.0, seed: int = 0) -> Workload:
    """A workload.

    Args:
        count: Gaussians.
        size: side of the image, px.
        splat_px: least standard deviation of a splat, px; the largest is twice that.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    points = _hand(count, rng) - np.array([0.0, 0.035, 0.0])
    turn = np.array(
        [[math.cos(0.25), 0, math.sin(0.25)], [0, 1, 0], [-math.sin(0.25), 0, math.cos(0.25)]]
    )
    points = points @ turn.T * np.array([1.0, -1.0, -1.0])
    focal = FOCAL * size
    depth = points[:, 2:] + DISTANCE
    sigma_px = splat_px * np.exp(rng.uniform(0.0, math.log(2.0), (count, 3)))
    viewmat = np.eye(4)
    viewmat[2, 3] = DISTANCE
    arrays = {
        "means": points,
        "quats": rng.normal(size=(count, 4)),
        "scales": sigma_px * depth / focal,
        "opacities": 1.0 / (1.0 + np.exp(-rng.normal(2.2, 0.3, count))),
        "colors": np.clip([0.8, 0.6, 0.5] + 0.15 * rng.normal(size=(count, 3)), 0.0, 1.0),
        "viewmats": viewmat[None],
        "Ks": np.array([[[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]]]),
        "backgrounds": np.ones((1, 3)),
    }
    tensors = {name: torch.from_numpy(array).float() for name, array in arrays.items()}
    return Workload(tensors, size)


def _hand(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) points spread evenly over the surfaces."""
    power = 1.6075  # Knud Thomsen's formula for the area of an ellipsoid
    a, b, c = PALM**power
    areas = [4 * math.pi * ((a * b + a * c + b * c) / 3) ** (1 / power)]
    areas += [2 * math.pi * r * length + 4 * math.pi * r * r for *_, length, r in FINGERS]
    shares = np.floor(count * np.array(areas) / sum(areas)).astype(int)
    shares[0] += count - shares.sum()
    parts = [_palm(shares[0], rng)]
    parts += [_finger(n, rng, *finger) for n, finger in zip(shares[1:], FINGERS, strict=True)]
    return np.concatenate(parts)


def _palm(count: int, rng: np.random.Generator) -> np.ndarray:
    """Even on an ellipsoid: directions kept with the share by which their area is stretched."""
    kept = np.zeros((0, 3))
    while len(kept) < count:
        unit = _directions(2 * count + 8, rng)
        stretch = np.linalg.norm(unit / PALM, axis=1) * PALM.min()
        kept = np.concatenate([kept, unit[rng.random(len(unit)) < stretch] * PALM])
    return kept[:count]


def _finger(
    count: int,
    rng: np.random.Generator,
    start: tuple[float, float, float],
    towards: tuple[float, float, float],
    length: float,
    radius: float,
) -> np.ndarray:
    """Even on a capsule: a cylinder with half a sphere at either end."""
    axis = np.array(towards) / np.linalg.norm(towards)
    side = np.cross(axis, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    wall = round(count * length / (length + 2 * radius))
    angle, height = 2 * math.pi * rng.random(wall), length * rng.random(wall)
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * up
    caps = _directions(count - wall, rng)
    ends = radius * caps + np.where(caps @ axis > 0, length, 0.0)[:, None] * axis
    return np.array(start) + np.concatenate([height[:, None] * axis + radius * ring, ends])


def _directions(count: int, rng: np.random.Generator) -> np.ndarray:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
