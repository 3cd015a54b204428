"""Weights of single pixels before any fit: does the pixel look like this hand in this light?"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import cv2
import numpy as np

from wildghand.prepass.assessment import CLEAN_FROM, CLEAN_SHARE, normal_value
from wildghand.prepass.measurements import FrameMeasurements

#: Distance of a pixel's tint from the skin's, in those of the clean frames at the same place, at
#: which its weight has halved. Half of it takes more away than it saves
#: (docs/studies/prepass.md).
TINT_SCALE = 4.0
#: Factor on both scales in a frame that is surely clean. Little can cover the hand there, and what
#: looks odd (nails, rings, seams of a glove a little off their place) belongs to it.
CLEAN_SCALE = 4.0
# Residual, in those of the clean frames at the same place, at which a pixel's weight has halved.
_RESIDUAL_SCALE = 2.5
# Pixels that what is normal in the clean frames is worth in what is normal at a place.
_PRIOR = 20.0
# Edge of the window over which residuals are shared out, px.
_WINDOW = 5
# Least residual of clean frames, log: about what a sensor's noise leaves.
_LEAST_LEVEL = 0.03
# Share of a pixel's weight that remains where the mask has no hand.
_UNMASKED = 0.3


def weigh_pixels(
    masks: np.ndarray,
    measured: Mapping[int, FrameMeasurements],
    clean: np.ndarray,
    known: np.ndarray,
) -> np.ndarray:
    """Weigh the pixels of all frames.

    Two factors are multiplied. The residual under the intensity model measures whether the place
    looks as in other frames. If only perturbed frames show a place, the model has learnt the
    object that covers it; the tint measures, for every place, whether the pixel is skin. In a frame
    that is surely clean more is allowed (`CLEAN_SCALE`).

    Args:
        masks: (R, H, W) uint8, 255 = visible hand.
        clean: (R,) probability that nothing perturbs a frame.
        known: (C,) bool, the cells of the surface that clean frames from different parts of the
            clip show.

    Returns:
        (R, H, W) uint8, 255 = full weight; 255 also outside silhouette and mask, where there is
        nothing to judge by.
    """
    found, cell_count = list(measured.values()), len(known)
    cells = [one.cells for one in found]
    trusts = clean[list(measured)].tolist()
    residuals = [one.residual for one in found]
    tints = [one.tint for one in found]
    levels = np.array([one.level for one in found])
    tint_levels = np.array([np.median(tint) for tint in tints])
    level, tint_level = (
        max(normal_value(values, CLEAN_SHARE)[0], _LEAST_LEVEL) for values in (levels, tint_levels)
    )
    # Where clean frames all fit badly, the larger of both means is what is normal.
    normal = np.maximum(
        normal_residuals(residuals, cells, trusts, cell_count, level),
        geometric_normals(residuals, cells, trusts, cell_count, level),
    )
    normal_tint = geometric_normals(tints, cells, trusts, cell_count, tint_level)
    weights = np.full(masks.shape, 255, dtype=np.uint8)
    for row, one in measured.items():
        seen = masks[row].reshape(-1) / 255.0
        weight = np.ones(seen.size)
        shared = _shared(one.residual, one.pixels, masks[row].shape)
        allowed = 1.0 + (CLEAN_SCALE - 1.0) * _sureness(clean[row])
        # An object that stays for one episode passes for clean where no other frame shows the hand:
        # there a residual is allowed to the pixels alone that have the colour of the hand.
        safe = _amid(known[one.cells], one.pixels, masks[row].shape)
        half_tint = TINT_SCALE * normal_tint[one.cells]
        tinted = _fit(one.tint, np.where(safe, allowed, 1.0) * half_tint)
        spared = 1.0 + (allowed - 1.0) * tinted
        weight[one.pixels] = (
            _fit(shared, spared * _RESIDUAL_SCALE * normal[one.cells])
            * tinted
            * (_UNMASKED + (1.0 - _UNMASKED) * seen[one.pixels])
        )
        weight[one.beyond] = _fit(one.tint_beyond, allowed * TINT_SCALE * tint_level)
        weights[row] = np.round(255.0 * weight).reshape(masks[row].shape)
    return weights


def normal_residuals(
    residuals: Sequence[np.ndarray],
    cells: Sequence[np.ndarray],
    trusts: Sequence[float],
    cell_count: int,
    level: float,
) -> np.ndarray:
    """(C,) float32 residual of each cell of the surface in clean frames, at least the level.

    Nails, creases and places in shadow fit worse than the rest in every frame, which is not a
    sign of a perturbation. Residuals are clipped at five times the level, so that one frame with
    an object does not raise the normal residual of a place.

    Args:
        residuals, cells: (P,) for each frame.
        trusts: for each frame how much it counts, in [0, 1].
    """
    clipped = (np.minimum(residual, 5.0 * level) for residual in residuals)
    sums, mass = _sums(clipped, cells, trusts, np.zeros(cell_count))
    return np.maximum((sums + _PRIOR * level) / (mass + _PRIOR), level).astype(np.float32)


def geometric_normals(
    distances: Sequence[np.ndarray],
    cells: Sequence[np.ndarray],
    trusts: Sequence[float],
    cell_count: int,
    level: float,
) -> np.ndarray:
    """(C,) float32 distance of each cell from what is expected of it, in clean frames.

    Nails and tattoos are far from the skin's tint in every frame, a place under an object in some.
    The mean is geometric: the first it follows all the way, the second hardly moves it. It is at
    least the level. Arguments are those of `normal_residuals`.
    """
    above = (np.log(np.maximum(distance, level) / level) for distance in distances)
    sums, mass = _sums(above, cells, trusts, np.full(cell_count, _PRIOR))
    return (level * np.exp(sums / mass)).astype(np.float32)


def _sums(
    several: Iterable[np.ndarray],
    cells: Sequence[np.ndarray],
    trusts: Sequence[float],
    mass: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted sums of values in (C,) cells, and the weights, which are added to `mass`."""
    sums = np.zeros(len(mass))
    for values, cell, trust in zip(several, cells, trusts, strict=True):
        sums += trust * np.bincount(cell, values, minlength=len(mass))
        mass = mass + trust * np.bincount(cell, minlength=len(mass))
    return sums, mass


def _sureness(clean: float) -> float:
    """In [0, 1], how sure it is that a frame is clean; 0 where it is as likely perturbed."""
    return max(0.0, (clean - CLEAN_FROM) / (1.0 - CLEAN_FROM))


def _shared(residual: np.ndarray, pixels: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """(P,) half of each pixel's own residual and half the mean of its surroundings."""
    planes = np.zeros((size[0] * size[1], 2), dtype=np.float32)
    planes[pixels, 0] = residual
    planes[pixels, 1] = 1.0
    around = cv2.blur(planes.reshape(*size, 2), (_WINDOW, _WINDOW)).reshape(-1, 2)[pixels]
    mean: np.ndarray = around[:, 0] / np.maximum(around[:, 1], 1e-6)
    return 0.5 * residual + 0.5 * mean


def _amid(known: np.ndarray, pixels: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """(P,) bool: whether the pixel's place and its neighbours are known."""
    unknown = np.zeros(size, dtype=np.uint8)
    unknown.reshape(-1)[pixels] = ~known
    near = cv2.dilate(unknown, np.ones((_WINDOW, _WINDOW), dtype=np.uint8))
    found: np.ndarray = near.reshape(-1)[pixels] == 0
    return found


def _fit(distance: np.ndarray, half: np.ndarray | float) -> np.ndarray:
    """1 where nothing is off, a half where the distance is `half`, soon 0 beyond."""
    result: np.ndarray = 1.0 / (1.0 + (distance / half) ** 4)
    return result
