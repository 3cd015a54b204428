"""Objects on the skin: hand lotion with its tube, and a wrist watch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import Material, Surface, join, plain, transformed
from hwp_bench.sim.props.shapes import albedo, canvas, grid, ink, turned

_LABEL_TEXTURE = 128
# Half axes of the wrist, m, and half the width of the strap.
_WRIST = (0.036, 0.026)
_STRAP = 0.011


def build(name: str, variant: int) -> Surface:
    """Build a `lotion_tube`, a dollop of `lotion`, or a `watch`."""
    return {"lotion_tube": _tube, "lotion": _dollop, "watch": _watch}[name](variant)


def _tube(variant: int) -> Surface:
    """A tube of 14 cm along z, its cap at -z."""
    import cv2

    label = canvas(_LABEL_TEXTURE, _LABEL_TEXTURE, (0.93, 0.95, 0.96))
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
    """A dollop of cream about 4 cm wide."""
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


def _watch(variant: int) -> Surface:
    return wrist_watch(_WRIST, (0.32, 0.18, 0.10))


def wrist_watch(wrist: tuple[float, float], color: tuple[float, float, float]) -> Surface:
    """Build a watch around the x axis, its dial to +y.

    Args:
        wrist: half axes of the strap along z and y, m.
        color: sRGB of the strap.
    """
    leather = plain(srgb_to_linear(np.array(color)), gloss=0.55)
    steel = plain((0.6, 0.6, 0.62), gloss=0.18, specular=0.6)
    angles = np.linspace(0.0, 2.0 * np.pi, 41)
    profile = ((-1.0, 0.0), (-1.0, 0.0028), (1.0, 0.0028), (1.0, 0.0))
    rows = [
        np.stack(
            [
                np.full_like(angles, side * _STRAP),
                (wrist[1] + lift) * np.cos(angles),
                (wrist[0] + lift) * np.sin(angles),
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
    return join([strap, *(transformed(part, _upright(wrist[1])) for part in (case, dial))])


def _upright(top: float) -> np.ndarray:
    """z to +y, on top of a wrist of that height, m."""
    move = np.eye(4)
    move[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    move[1, 3] = top + 0.001
    return move


def _flat_disc(radius: float, height: float, material: Material) -> Surface:
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
