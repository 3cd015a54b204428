"""Differences of pictures on the surface of a hand, to second order in the variables of a frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.importers.shared.row_products import row_products
from hwp_bench.importers.video.clip_model import ClipModel
from hwp_bench.importers.video.surface_motion import (
    FRAME_VARIABLES,
    SurfaceMotion,
    frame_variables,
)

# Rows in a product of matrices.
_BLOCK = 24


@dataclass(frozen=True, eq=False)
class Differences:
    """A frame compared with what is expected of it, at P pixels; C channels.

    Attributes:
        face: (P,) the face that each pixel shows, or that is nearest to it.
        mix: (P, 2) barycentric coordinates as `draw_faces` returns them.
        error: (P, C) the frame less what is expected.
        across: (P, C) how the picture changes to the right, by px of the images.
        down: (P, C) the same downwards.
        trust: (P,) weights.
    """

    face: np.ndarray
    mix: np.ndarray
    error: np.ndarray
    across: np.ndarray
    down: np.ndarray
    trust: np.ndarray


#: Curvature (51, 51) and slope (51,) of one frame.
Quadratic = tuple[np.ndarray, np.ndarray]


def no_quadratic() -> Quadratic:
    """Return that of a frame that says nothing."""
    return np.zeros((FRAME_VARIABLES,) * 2), np.zeros(FRAME_VARIABLES)


def linearised(
    motion: SurfaceMotion, frame: int, faces: np.ndarray, found: Differences, ratio: float
) -> Quadratic:
    """Differentiate half the weighed squared differences by the variables of their frame.

    A surface that moves by u takes its picture with it, so that a pixel gets less of what is
    ahead of it: the difference grows by the picture's slope times u.

    Args:
        motion: how vertices move in the whole frame.
        frame: which frame.
        faces: (T, 3) of the hand.
        found: the differences.
        ratio: px of the images to one px of the whole frame.
    """
    shares = np.stack([1.0 - found.mix.sum(axis=1), found.mix[:, 0], found.mix[:, 1]], axis=1)
    corners = faces[found.face].ravel()
    count = int(faces.max()) + 1

    def collected(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        spread = shares * (found.trust * row_products(first, second))[:, None]
        return np.bincount(corners, spread.ravel(), minlength=count)

    across, down = found.across, found.down
    xx, xy, yy = collected(across, across), collected(across, down), collected(down, down)
    used = np.flatnonzero(xx + yy > 0)
    rates = motion.by_variables(frame, used) * ratio
    xx, xy, yy = (part[used, None] for part in (xx, xy, yy))
    x, y = rates[:, 0], rates[:, 1]
    weighed = np.stack([xx * x + xy * y, xy * x + yy * y], axis=1)
    pull = np.stack([collected(part, found.error)[used] for part in (across, down)], axis=1)
    return _summed(rates, weighed), np.einsum("pak,pa->k", rates, pull)


class FrameQuadratic:
    """An energy that is quadratic in the variables of each frame; zero where it was linearised.

    Args:
        model: the clip, as it is now.
        usable: frames that count.
        found: their curvatures and slopes, in this order.
        weight: of the energy.
    """

    def __init__(
        self, model: ClipModel, usable: Sequence[int], found: Iterable[Quadratic], weight: float
    ) -> None:
        self._weight = weight
        self._start = frame_variables(model.variables).detach().clone()
        frames = len(self._start)
        curvature = np.zeros((frames, FRAME_VARIABLES, FRAME_VARIABLES))
        slope = np.zeros((frames, FRAME_VARIABLES))
        for frame, (bent, steep) in zip(usable, found, strict=True):
            curvature[frame], slope[frame] = bent, steep
        self._curvature = torch.as_tensor(curvature, dtype=torch.float32)
        self._slope = torch.as_tensor(slope, dtype=torch.float32)

    def __call__(self, model: ClipModel) -> torch.Tensor:
        """Return the energy, a scalar."""
        step = frame_variables(model.variables) - self._start
        bent = (self._curvature @ step[..., None])[..., 0]
        return self._weight * (step * (0.5 * bent + self._slope)).sum()


def _summed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Sum over P and 2 of the products of (P, 2, K) and (P, 2, K): (K, K).

    In blocks that are too small for BLAS to start threads of its own next to those that frames
    are worked on in; so the result does not depend on their number either.
    """
    rows = np.zeros((2, -(-2 * len(first) // _BLOCK) * _BLOCK, first.shape[2]))
    for row, part in zip(rows, (first, second), strict=True):
        row[: 2 * len(part)] = part.reshape(-1, part.shape[2])
    left, right = rows.reshape(2, -1, _BLOCK, first.shape[2])
    return np.asarray((left.transpose(0, 2, 1) @ right).sum(axis=0))
