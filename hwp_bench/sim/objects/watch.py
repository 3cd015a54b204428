"""A wrist watch: strap around the wrist, case and dial."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.objects.paint import albedo, canvas, ink
from hwp_bench.sim.objects.shapes import grid, turned
from hwp_bench.sim.surface import Material, Surface, join, plain, transformed

# Half axes of the wrist, m, and half the width of the strap.
_WRIST = (0.036, 0.026)
_STRAP = 0.011


def build(name: str, variant: int) -> Surface:
    """Build a watch around the x axis, its dial to +y."""
    leather = plain(srgb_to_linear(np.array([0.32, 0.18, 0.10])), gloss=0.55)
    steel = plain((0.6, 0.6, 0.62), gloss=0.18, specular=0.6)
    angles = np.linspace(0.0, 2.0 * np.pi, 41)
    profile = ((-1.0, 0.0), (-1.0, 0.0028), (1.0, 0.0028), (1.0, 0.0))
    rows = [
        np.stack(
            [
                np.full_like(angles, side * _STRAP),
                (_WRIST[1] + lift) * np.cos(angles),
                (_WRIST[0] + lift) * np.sin(angles),
            ],
            axis=1,
        )
        for side, lift in profile
    ]
    strap = grid(np.concatenate(rows), len(rows), len(angles), leather)
    outward = strap.vertices * np.array([0.0, 1.0, 1.0])
    if np.einsum("ni,ni->n", strap.normals, outward).sum() < 0:
        strap = grid(np.concatenate(rows), len(rows), len(angles), leather, flip=True)
    case = turned(
        np.array([[0.0, 0.0], [0.019, 0.0], [0.02, 0.003], [0.02, 0.007], [0.018, 0.009]]), steel
    )
    face = Material(albedo=albedo(_dial()), gloss=0.15)
    dial = _flat_disc(0.0182, 0.0088, face)
    return join([strap, *(transformed(part, _upright()) for part in (case, dial))])


def _upright() -> np.ndarray:
    """z to +y, on top of the wrist."""
    move = np.eye(4)
    move[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    move[1, 3] = _WRIST[1] + 0.001
    return move


def _flat_disc(radius: float, height: float, material: Material) -> Surface:
    from dataclasses import replace

    disc = turned(np.array([[radius, height - 1e-4], [1e-4, height]]), material)
    uv = disc.vertices[disc.faces][..., :2] / (2.0 * radius) + 0.5
    return replace(disc, corner_uv=uv, normals=np.tile([0.0, 0.0, 1.0], (len(disc.vertices), 1)))


def _dial() -> np.ndarray:
    import cv2

    image = canvas(128, 128, (0.05, 0.09, 0.2))
    white = ink((0.95, 0.95, 0.9))
    for hour in range(12):
        angle = hour * np.pi / 6
        start = (int(64 + 50 * np.cos(angle)), int(64 + 50 * np.sin(angle)))
        end = (int(64 + 58 * np.cos(angle)), int(64 + 58 * np.sin(angle)))
        cv2.line(image, start, end, white, 4, cv2.LINE_AA)
    cv2.line(image, (64, 64), (64, 26), white, 4, cv2.LINE_AA)
    cv2.line(image, (64, 64), (90, 76), white, 5, cv2.LINE_AA)
    return image
