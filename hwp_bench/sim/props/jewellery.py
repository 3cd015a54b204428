"""Rings and bracelets: closed bands around z, shaped to what they are worn on."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.surface import Material, Surface, join, plain, transformed
from hwp_bench.sim.props.shapes import grid, turned

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
    return plain(srgb_to_linear(np.array(color)), gloss=roughness, specular=0.55)


def angles() -> np.ndarray:
    """The angles at which a band's outline is given: (AROUND,) rad, from x towards y."""
    return np.linspace(0.0, 2.0 * np.pi, AROUND)


def band(outline: np.ndarray, width: float, thickness: float, material: Material) -> Surface:
    """A closed band with a rounded section.

    Args:
        outline: (AROUND,) m from the axis at each of `angles()`: its inner side.
        width: along the axis, m.
        thickness: m.
        material: what it is made of.
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
    gem = plain(srgb_to_linear(np.array(color)), gloss=0.08, specular=0.12)
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
