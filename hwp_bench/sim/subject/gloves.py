"""Gloves: which places of the rest hand they cover, and what cloth looks like there."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands.poses import FIRST_JOINT
from hwp_bench.hands.skeleton import FINGERS
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.scene.looks import Glove
from hwp_bench.sim.subject.anatomy import Anatomy
from hwp_bench.sim.subject.skin import SkinSample

#: How far a glove reaches behind the wrist, m.
CUFF = 0.045
# Share of the first finger bone that a fingerless glove covers.
_COVERED = 0.62
# Width of the rim's step and of its hem, m.
_RIM, _HEM = 0.0009, 0.0055
# Distance of the cloth's threads, m.
_THREAD = 0.0021


def inside_glove(anatomy: Anatomy, glove: Glove) -> np.ndarray:
    """Distance from the glove's rim, m: (N,), positive where it covers the hand."""
    forward = unit(anatomy.joints[4] - anatomy.joints[0])
    inside = (anatomy.points - anatomy.joints[0]) @ forward + CUFF
    if glove.kind == "work":
        return inside
    for finger in FINGERS:
        first = FIRST_JOINT[finger]
        start = first + (1 if finger == "thumb" else 0)
        bone = anatomy.joints[start + 1] - anatomy.joints[start]
        length = float(np.linalg.norm(bone))
        beyond = (anatomy.points - anatomy.joints[start]) @ bone / length - _COVERED * length
        owned = anatomy.weights[:, first : first + 3].sum(axis=1) > 0.5
        inside = np.where(owned, np.minimum(inside, -beyond), inside)
    return inside


def covered(anatomy: Anatomy, glove: Glove) -> np.ndarray:
    """Share of glove at each place: (N,), 0-1, soft at the rim."""
    return _step(inside_glove(anatomy, glove) / _RIM + 0.5)


def gloved(anatomy: Anatomy, glove: Glove, skin: SkinSample, *, fine: bool) -> SkinSample:
    """Put a glove over skin.

    Args:
        anatomy: where the places are on the hand.
        glove: which.
        skin: what is below.
        fine: also threads and stitches, which only a dense sampling can hold.
    """
    inside = inside_glove(anatomy, glove)
    cover = _step(inside / _RIM + 0.5)
    rng = generator(glove.seed, "glove")
    coarse, middle, grain = (
        fractal_noise(anatomy.points, scale, rng) for scale in (0.03, 0.012, 0.0025)
    )
    back = anatomy.back
    hem = _step(1.5 - np.abs(inside / _HEM - 0.5) * 2.0)
    grip = _step((0.45 - back) / 0.16 + 0.5)
    fingers = 1.0 - anatomy.weights[:, 0]
    seam = np.exp(-(((back - 0.55) / 0.10) ** 2)) * _step(2.0 * fingers - 0.4)
    forward = unit(anatomy.joints[4] - anatomy.joints[0])
    along = (anatomy.points - anatomy.joints[0]) @ forward
    cuff = _step((0.012 - along) / 0.002 + 0.5) if glove.kind == "work" else np.zeros(len(along))
    height = glove.thickness + 0.00025 * coarse + 0.00018 * middle + 0.0005 * hem - 0.0004 * seam
    cloth, leather = srgb_to_linear(np.array(glove.color)), srgb_to_linear(np.array(glove.palm))
    color = cloth + grip[:, None] * (leather - cloth)
    color = color + (cuff * 0.75)[:, None] * (0.45 * cloth + 0.02 - color)
    shade = 0.9 + 0.10 * coarse + 0.08 * middle - 0.18 * np.clip(coarse + 0.5 * grain - 0.9, 0, 1)
    shade = shade * (1.0 - 0.45 * seam) * (1.0 - 0.15 * hem)
    if fine:
        rows = np.cos(2.0 * np.pi * anatomy.points[:, 0] / _THREAD)
        columns = np.cos(
            2.0 * np.pi * (anatomy.points[:, 2] - 0.5 * anatomy.points[:, 1]) / _THREAD
        )
        knit = rows * columns * (1.0 - grip)
        ribs = np.cos(2.0 * np.pi * anatomy.points[:, 2] / 0.004) * cuff
        stitch = np.exp(-(((inside - _HEM) / 0.0005) ** 2)) * (columns + rows > 0.0)
        shade = shade * (1.0 + 0.07 * knit + 0.12 * ribs + 0.03 * grain - 0.4 * stitch)
        height = height + 0.00008 * knit + 0.0002 * ribs + 0.00004 * grain - 0.0002 * stitch
    color = color * np.clip(shade, 0.2, 1.5)[:, None]
    matt = 0.88 - 0.26 * grip
    return SkinSample(
        albedo=np.clip(skin.albedo + cover[:, None] * (color - skin.albedo), 0.01, 0.95),
        height=skin.height + cover * (height - skin.height),
        roughness=skin.roughness + cover * (matt - skin.roughness),
    )


def _step(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
