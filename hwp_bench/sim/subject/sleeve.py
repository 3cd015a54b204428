"""The sleeve: closes the open wrist of the hand model and leads out of the image."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands.template import boundary_loop
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.geometry.surface import Material, Surface
from hwp_bench.sim.subject.limb import ringed

if TYPE_CHECKING:
    from hwp_bench.hands import HandTemplate

# Rings along the arm, m behind the wrist's rim; the first two make the cuff's fold.
_RINGS = (0.006, -0.003, -0.004, 0.002, 0.014, 0.032, 0.06, 0.1, 0.15, 0.22, 0.3)
_WIDTHS = (1.02, 1.06, 1.17, 1.22, 1.2, 1.22, 1.25, 1.3, 1.36, 1.45, 1.55)
_AROUND = 40
_TEXTURE = 256


@lru_cache(maxsize=2)
def sleeve_material(color: tuple[float, float, float], seed: int) -> Material:
    """Knitted cloth in one colour (sRGB), with ribs and mottling."""
    ticks = np.linspace(0.0, 1.0, _TEXTURE, endpoint=False)
    u, v = np.meshgrid(ticks, ticks)
    ribs = 0.5 + 0.5 * np.cos(2.0 * np.pi * 28.0 * u)
    points = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=1)
    mottle = fractal_noise(points, 0.08, generator(seed, "sleeve")).reshape(u.shape)
    shade = 0.8 + 0.2 * ribs + 0.08 * mottle
    albedo = srgb_to_linear(np.array(color))[None, None] * shade[..., None]
    return Material(
        albedo=np.clip(albedo, 0.0, 1.0).astype(np.float32),
        gloss=0.9,
        specular=0.02,
        height=(0.0006 * ribs).astype(np.float32),
    )


@lru_cache(maxsize=4)
def wrist_rim(template: HandTemplate) -> np.ndarray:
    """Indices of the template's vertices around its open wrist, in order."""
    return boundary_loop(template.faces)


def sleeve(rim: np.ndarray, forward: np.ndarray, elbow: np.ndarray, material: Material) -> Surface:
    """Build a sleeve from the rim of a posed wrist towards the elbow.

    Args:
        rim: (R, 3) m, the wrist's rim in order.
        forward: (3,) unit vector from the wrist to the fingers.
        elbow: (3,) m.
        material: the cloth.
    """
    center = rim.mean(axis=0)
    side = unit(rim[0] - center - ((rim[0] - center) @ forward) * forward)
    third = np.cross(forward, side)
    angles = np.arctan2((rim - center) @ third, (rim - center) @ side)
    order = np.argsort(angles)
    around = np.linspace(-np.pi, np.pi, _AROUND, endpoint=False)
    radius = np.interp(
        around, angles[order], np.linalg.norm(rim - center, axis=1)[order], period=2 * np.pi
    )
    arm = unit(elbow - center)
    rings = []
    place, previous = center.copy(), 0.0
    for step, (back, width) in enumerate(zip(_RINGS, _WIDTHS, strict=True)):
        bend = np.clip(back / 0.12, 0.0, 1.0)
        heading = unit(-forward + bend * (arm + forward))
        place = center + back * -forward if step < 4 else place + (back - previous) * heading
        previous = back
        x = unit(side - (side @ heading) * heading)
        y = np.cross(x, heading)
        if y @ third < 0:
            y = -y
        round_up = np.clip(back / 0.15, 0.0, 1.0)
        size = width * (radius + round_up * (radius.mean() - radius))
        rings.append(
            place + size[:, None] * (np.cos(around)[:, None] * x + np.sin(around)[:, None] * y)
        )
    count = len(rings)
    spokes = np.arange(_AROUND)
    along = np.arange(count) / (count - 1) * 2.0
    around_uv = (spokes / _AROUND, (spokes + 1) / _AROUND)
    return ringed(np.concatenate(rings), around_uv, along, material)
