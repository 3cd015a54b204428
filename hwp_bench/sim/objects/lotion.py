"""Hand lotion: the tube, and the cream on the skin."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.objects.paint import albedo, canvas, ink
from hwp_bench.sim.objects.shapes import grid, turned
from hwp_bench.sim.seeds import generator
from hwp_bench.sim.surface import Material, Surface, join, plain

_TEXTURE = 128


def build(name: str, variant: int) -> Surface:
    """Build a tube of 14 cm along z (cap at -z), or a dollop of cream about 4 cm wide."""
    return _tube(variant) if name == "lotion_tube" else _dollop(variant)


def _tube(variant: int) -> Surface:
    import cv2

    label = canvas(_TEXTURE, _TEXTURE, (0.93, 0.95, 0.96))
    label[70:100] = ink((0.20, 0.55, 0.62))
    cv2.putText(label, "care", (22, 52), cv2.FONT_HERSHEY_DUPLEX, 1.2, ink((0.1, 0.3, 0.4)), 3)
    skin = Material(albedo=albedo(label), gloss=0.3)
    ticks = np.linspace(0.0, 1.0, 12)
    angles = np.linspace(0.0, 2.0 * np.pi, 33)
    radius = 0.019
    flat = 1.0 - 0.93 * ticks**1.5
    wide = 1.0 + 0.25 * ticks**1.5
    vertices = np.stack(
        [
            radius * wide[:, None] * np.cos(angles),
            radius * flat[:, None] * np.sin(angles),
            np.broadcast_to((-0.05 + 0.12 * ticks)[:, None], (len(ticks), len(angles))),
        ],
        axis=-1,
    ).reshape(-1, 3)
    cap = plain(srgb_to_linear(np.array([0.15, 0.42, 0.5])), gloss=0.35)
    lid = np.array([[0.0, -0.072], [0.016, -0.072], [0.0165, -0.052], [0.019, -0.05]])
    return join([grid(vertices, len(ticks), len(angles), skin), turned(lid, cap)])


def _dollop(variant: int) -> Surface:
    rng = generator(11, "dollop", variant)
    cream = plain((0.88, 0.87, 0.84), gloss=0.28, specular=0.05)
    profile_at = np.linspace(0.0, 1.0, 9)
    angles = np.linspace(0.0, 2.0 * np.pi, 33)
    waves = sum(
        rng.normal(0.0, 0.18 / k) * np.cos(k * angles + rng.uniform(0, 6.3)) for k in (2, 3, 5)
    )
    radius = 0.02 * (1.0 + waves)
    profile = np.sin(profile_at * np.pi / 2)
    height = 0.006 * np.cos(profile_at * np.pi / 2) ** 0.7
    swirl = (
        0.0012 * np.sin(3 * angles[None] + 9.0 * profile_at[:, None]) * (1 - profile_at[:, None])
    )
    vertices = np.stack(
        [
            profile[:, None] * radius * np.cos(angles),
            profile[:, None] * radius * np.sin(angles),
            height[:, None] + swirl - 0.0015,
        ],
        axis=-1,
    ).reshape(-1, 3)
    sheet = grid(vertices, len(profile_at), len(angles), cream)
    if sheet.normals[:, 2].mean() < 0:
        sheet = grid(vertices, len(profile_at), len(angles), cream, flip=True)
    return sheet
