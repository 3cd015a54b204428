"""Things from a table: a mug, a ball, a spoon, a banana."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import Material, Surface, join, plain
from hwp_bench.sim.props.shapes import albedo, canvas, ink, tube, turned

_MUGS = ((0.86, 0.84, 0.78), (0.16, 0.32, 0.36), (0.72, 0.30, 0.18))
_BALLS = (((0.9, 0.9, 0.88), (0.1, 0.1, 0.12)), ((0.85, 0.2, 0.15), (0.95, 0.85, 0.3)))


def build(name: str, variant: int) -> Surface:
    """Build a `mug`, a `ball`, a `spoon` or a `banana`."""
    return {"mug": _mug, "ball": _ball, "spoon": _spoon, "banana": _banana}[name](variant)


def _mug(variant: int) -> Surface:
    """A mug of 9 cm along z, open at +z, its handle at +x."""
    import cv2

    color = _MUGS[variant % len(_MUGS)]
    image = canvas(96, 256, color)
    band = (0.55 * color[0], 0.55 * color[1], 0.55 * color[2])
    image[64:74] = ink(band)
    rng = generator(21, "mug", variant)
    for _ in range(9):
        place = (int(rng.integers(12, 244)), int(rng.integers(18, 54)))
        cv2.circle(image, place, int(rng.integers(3, 9)), ink(band), -1, cv2.LINE_AA)
    glaze = Material(albedo=albedo(image), gloss=0.18)
    inside = plain(srgb_to_linear(np.array([0.93, 0.92, 0.88])), gloss=0.2)
    outer = np.array([[0.0, -0.045], [0.034, -0.045], [0.039, -0.04], [0.041, 0.043]])
    inner = np.array([[0.041, 0.043], [0.038, 0.045], [0.0365, 0.04], [0.034, -0.038], [0, -0.04]])
    bend = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 15)
    spine = np.stack(
        [0.039 + 0.026 * np.cos(bend), np.zeros_like(bend), 0.027 * np.sin(bend)], axis=1
    )
    handle = tube(spine, np.full(len(spine), 0.0055), glaze)
    return join([turned(outer, glaze, 40), turned(inner, inside, 40), handle])


def _ball(variant: int) -> Surface:
    """A ball of 62 mm with patches of two colours."""
    import cv2

    base, patch = _BALLS[variant % len(_BALLS)]
    image = canvas(128, 256, base)
    for row, count in ((24, 3), (64, 6), (104, 3)):
        for k in range(count):
            place = (int(256 * (k + 0.5 * (row == 64)) / count), row)
            cv2.ellipse(image, place, (14, 11), 0, 0, 360, ink(patch), -1, cv2.LINE_AA)
    along = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 25)
    profile = 0.031 * np.stack([np.cos(along), np.sin(along)], axis=1)
    return turned(profile, Material(albedo=albedo(image), gloss=0.35), 40)


def _spoon(variant: int) -> Surface:
    """A wooden or steel spoon of 19 cm along z, its bowl at +z, hollow to +y."""
    wood = plain(srgb_to_linear(np.array([0.62, 0.42, 0.24])), gloss=0.6)
    steel = plain((0.58, 0.58, 0.6), gloss=0.2, specular=0.6)
    material = steel if variant % 2 else wood
    along = np.linspace(0.0, 1.0, 25)
    spine = np.stack([np.zeros(25), -0.006 * along**2, -0.1 + 0.135 * along], axis=1)
    shaft = tube(spine, 0.0045 - 0.0012 * along, material)
    across = np.linspace(0.0, np.pi, 17)
    # Half of an ellipsoid: a turned profile about z, flattened along y.
    bowl = turned(np.stack([0.02 * np.sin(across), 0.03 * np.cos(across)], axis=1), material, 32)
    flat = bowl.vertices * np.array([1.0, 0.32, 1.0])
    flat[:, 1] = np.where(flat[:, 1] > 0.0, 0.45 * flat[:, 1], flat[:, 1])
    vertices = flat + np.array([0.0, -0.006, 0.062])
    normals = bowl.normals * np.array([1.0, 3.0, 1.0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return join([shaft, replace(bowl, vertices=vertices, normals=normals)])


def _banana(variant: int) -> Surface:
    """A banana of 17 cm, bent in the plane of y and z."""
    rng = generator(22, "banana", variant)
    image = canvas(64, 256, (0.93, 0.78, 0.22))
    for _ in range(30 + 40 * (variant % 2)):
        row, column = int(rng.integers(0, 64)), int(rng.integers(0, 256))
        image[row : row + 2, column : column + int(rng.integers(2, 9))] = ink((0.45, 0.30, 0.12))
    image[:, :5] = image[:, -7:] = ink((0.35, 0.26, 0.12))
    peel = Material(albedo=albedo(np.ascontiguousarray(image.transpose(1, 0, 2))), gloss=0.45)
    along = np.linspace(0.0, 1.0, 31)
    angle = 1.25 * (along - 0.5)
    spine = np.stack([np.zeros(31), 0.13 * (1.0 - np.cos(angle)), 0.13 * np.sin(angle)], axis=1)
    radius = 0.018 * np.sqrt(np.clip(4.0 * along * (1.0 - along), 0.06, 1.0))
    return tube(spine, radius, peel, around=20)
