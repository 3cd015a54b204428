"""Rings, bracelets and watches: settings, and meshes shaped to what they are worn on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from hwp_bench.base.records import number
from hwp_bench.sim.geometry.surface import (
    Color,
    Material,
    Surface,
    albedo,
    canvas,
    coat,
    grid,
    ink,
    join,
    plain,
    transformed,
    turned,
)
from hwp_bench.sim.subject.covers import Wearing

#: Points around a band; its first and last are the same.
AROUND = 49
# Points of a band's section.
_SECTION = 13
#: sRGB and roughness of metals.
METALS: Mapping[str, tuple[tuple[float, float, float], float]] = MappingProxyType(
    {
        "gold": ((0.83, 0.62, 0.28), 0.22),
        "silver": ((0.80, 0.80, 0.79), 0.20),
        "steel": ((0.58, 0.59, 0.61), 0.26),
        "black": ((0.10, 0.10, 0.11), 0.30),
    }
)


def metal(name: str) -> Material:
    """A polished metal by its name in `METALS`."""
    color, roughness = METALS[name]
    return coat(color, gloss=roughness, specular=0.55)


def angles() -> np.ndarray:
    """The angles at which a band's outline is given: (AROUND,) rad, from x towards y."""
    return np.linspace(0.0, 2.0 * np.pi, AROUND)


def band(outline: np.ndarray, width: float, thickness: float, material: Material) -> Surface:
    """A closed band with a rounded section.

    Takes `outline` (AROUND,) m from the axis at each of `angles()`.
    """
    turn = np.linspace(0.0, 2.0 * np.pi, _SECTION)
    # A superellipse: flat outside, round at the edges.
    along = 0.5 * width * np.sign(np.cos(turn)) * np.abs(np.cos(turn)) ** 0.6
    out = 0.5 * thickness * (1.0 + np.sign(np.sin(turn)) * np.abs(np.sin(turn)) ** 0.6)
    radius = outline[None] + out[:, None]
    around = angles()
    vertices = np.stack(
        [
            radius * np.cos(around),
            radius * np.sin(around),
            np.broadcast_to(along[:, None], radius.shape),
        ],
        axis=-1,
    ).reshape(-1, 3)
    made = grid(vertices, _SECTION, AROUND, material)
    center = np.stack([outline * np.cos(around), outline * np.sin(around), 0.0 * around], axis=1)
    away = vertices - np.tile(center + 0.5 * thickness * center / outline[:, None], (_SECTION, 1))
    if np.einsum("ni,ni->n", made.normals, away).sum() < 0:
        made = grid(vertices, _SECTION, AROUND, material, flip=True)
    return made


def stone(diameter: float, color: tuple[float, float, float], setting: Material) -> Surface:
    """A cut stone in its setting, on the plane z = 0."""
    r = 0.5 * diameter
    cup = turned(
        np.array([[0.75 * r, -0.3 * r], [1.12 * r, 0.35 * r], [0.95 * r, 0.45 * r]]), setting
    )
    gem = coat(color, gloss=0.08, specular=0.12)
    cut = turned(
        np.array([[1.0 * r, 0.3 * r], [0.98 * r, 0.5 * r], [0.6 * r, 0.85 * r], [1e-5, 0.86 * r]]),
        gem,
        around=8,
    )
    return join([cup, cut])


def beads(outline: np.ndarray, diameter: float, material: Material) -> Surface:
    """A string of beads along an outline as in `band`."""
    way = np.linspace(0.0, np.pi, 7)
    ball = turned(
        0.5 * diameter * np.stack([np.sin(way) + 1e-6, -np.cos(way)], axis=1), material, 10
    )
    length = 2.0 * np.pi * float(np.mean(outline)) + np.pi * diameter
    count = int(length / (1.03 * diameter))
    parts = []
    for turn in np.linspace(0.0, 2.0 * np.pi, count, endpoint=False):
        move = np.eye(4)
        radius = np.interp(turn, angles(), outline) + 0.5 * diameter
        move[:2, 3] = radius * np.cos(turn), radius * np.sin(turn)
        parts.append(transformed(ball, move))
    joined = join(parts)
    return joined


#: A finger.
Finger = Literal["thumb", "index", "middle", "ring", "little"]


@dataclass(frozen=True)
class Ring:
    """A ring around the first bone of a finger."""

    #: Which finger.
    finger: Finger
    #: What it is made of.
    metal: Literal["gold", "silver", "steel", "black"] = "gold"
    #: Width along the finger, m.
    width: float = number(0.004, 0.0015, 0.012)
    #: Diameter of a stone on the back, m; 0 for none.
    stone: float = number(0.0, 0.0, 0.012)
    #: sRGB of the stone.
    stone_color: Color = (0.75, 0.85, 0.95)
    #: The hand that wears it.
    side: Wearing = "both"


@dataclass(frozen=True)
class WristWear:
    """A watch or a bracelet; it does not count as hand."""

    #: A watch on a strap, a smooth bangle, or a string of beads.
    kind: Literal["watch", "bangle", "beads"]
    #: sRGB of strap, bangle or beads.
    color: Color = (0.32, 0.18, 0.10)
    #: The hand that wears it.
    side: Wearing = "left"


_STRAP = 0.011


def wrist_watch(wrist: tuple[float, float], color: tuple[float, float, float]) -> Surface:
    """Build a watch around the x axis, its dial to +y."""
    leather = coat(color, gloss=0.55)
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
