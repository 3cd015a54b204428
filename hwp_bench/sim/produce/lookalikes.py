"""Errors of an estimated mask where something next to the hand looks like skin.

A segmenter goes by colour and place: it takes background for hand where both fit, and drops hand
where the background on the other side of the border is alike. What looks like skin is read off
the frame itself, so that light, blur and compression count. It acts only in scenes with something
that can be confused with a hand; every other mask stays as `estimates.estimate_mask` made it.
"""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.effects.plan import FramePlan
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.props.planes import plane_names
from hwp_bench.sim.scene.behind import NOTHING
from hwp_bench.sim.scene.schema import Scene

#: How far errors reach, in pixels of an image of 256: background taken for hand, hand given up,
#: and patches apart from the hand.
LEAK, BITE, ISLAND = 12.0, 7.0, 45.0
#: How often they happen where the colours are the same: an error is there where a field of unit
#: variance, times the slope, plus this, passes 0.5.
OFTEN, SLOPE = {"leak": 0.30, "bite": 0.15, "island": -0.25}, 0.45
#: Size of the errors, share of the image, and how fast they change, 1/s.
PATCH, PACE = 0.07, 0.8
# Least spread of a hand's colour in CIELAB, and how much farther than that still looks alike.
_SPREAD, _ALIKE = np.array([14.0, 5.0, 5.0]), 1.6
# Hand pixels below which no colour is known.
_LEAST = 40


def confusable(scene: Scene) -> bool:
    """Whether something in a scene can be taken for a hand: backdrop, passers-by or a bare arm."""
    bare = scene.subject.looks.arm == "bare"
    return bare or scene.background in plane_names() or scene.behind != NOTHING


def confused_mask(
    scene: Scene, plan: FramePlan, mask: np.ndarray, coverage: np.ndarray, rgb: np.ndarray
) -> np.ndarray:
    """Add to an estimated mask what colours like skin do to it.

    Args:
        scene: the scene.
        plan: the frame's recipe.
        mask: (S, S) uint8, as `estimate_mask` gives it.
        coverage: (S, S) exact share of visible hand, 0-1.
        rgb: (S, S, 3) uint8 sRGB, the frame.

    Returns:
        (S, S) uint8, 255 = hand.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    hand = coverage > 0.5
    if not confusable(scene) or hand.sum() < _LEAST or hand.all():
        return mask
    unit = len(mask) / 256.0
    alike = likeness(rgb, coverage)
    outside = distance_transform_edt(~hand) / unit
    inside = distance_transform_edt(hand) / unit
    leak = _errs("leak", scene, plan, alike * np.exp(-((outside / LEAK) ** 2)))
    island = _errs("island", scene, plan, alike * np.exp(-((outside / ISLAND) ** 2)))
    # What lies across the border decides whether hand is given up.
    free = gaussian_filter((~hand).astype(np.float64), 5.0 * unit)
    across = gaussian_filter(alike * ~hand, 5.0 * unit) / np.maximum(free, 1e-3)
    bite = _errs("bite", scene, plan, across * np.exp(-((inside / BITE) ** 2)))
    share = np.where(hand, 0.0, np.maximum(leak, island))
    changed = np.maximum(mask / 255.0, share) * (1.0 - np.where(hand, bite, 0.0))
    return np.round(255.0 * changed).astype(np.uint8)


def likeness(rgb: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """How much every pixel looks like the hand of its frame: (S, S), 0-1.

    Args:
        rgb: (S, S, 3) uint8 sRGB.
        coverage: (S, S) share of hand; at least one pixel is more than half hand.
    """
    import cv2

    smooth = cv2.GaussianBlur(rgb, (0, 0), max(len(rgb) / 256.0, 0.3))
    lab = cv2.cvtColor((smooth / 255.0).astype(np.float32), cv2.COLOR_RGB2LAB)
    own = lab[coverage > 0.5]
    middle = np.median(own, axis=0)
    # 1.4826: from the median of distances to the standard deviation of a normal distribution.
    spread = np.maximum(1.4826 * np.median(np.abs(own - middle), axis=0), _SPREAD)
    distance = (((lab - middle) / (_ALIKE * spread)) ** 2).sum(axis=2)
    return np.asarray(np.exp(-0.5 * distance), dtype=np.float64)


def _errs(name: str, scene: Scene, plan: FramePlan, chance: np.ndarray) -> np.ndarray:
    """Where one kind of error is: (S, S), 0-1. It wanders over the seconds.

    Args:
        name: the kind.
        scene: the scene.
        plan: the frame's recipe.
        chance: (S, S) 0-1, how much colour and place speak for it.
    """
    size = len(chance)
    ticks = (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(ticks, ticks)
    moment = np.full(x.size, PATCH * PACE * plan.seconds)
    points = np.stack([x.ravel(), y.ravel(), moment], axis=1)
    field = fractal_noise(points, PATCH, generator(scene.seed, "lookalike", name), octaves=2)
    level = chance * np.clip(OFTEN[name] + SLOPE * field.reshape(x.shape), 0.0, 1.0)
    return np.clip((level - 0.5) / 0.12 + 0.5, 0.0, 1.0)
