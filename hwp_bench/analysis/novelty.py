"""How new the pixels of a test frame are: what the training frames showed of the same places.

A place is a cell of 4 mm on the rest hand. A pixel is new in two ways: its surface may face
another way than in every training frame that shows the place, which is light and view that
nobody has seen; or the place may be seen in few training frames, or in none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.capture import Capture
from hwp_bench.capture.splits import Split
from hwp_bench.hands.anchors import Footprint, HandSurfaces
from hwp_bench.metrics.pixels import hand_pixels

#: Edge of a cell, m.
PATCH = 0.004
# Training frames that are compared at a time.
_CHUNK = 64


@dataclass(frozen=True, eq=False)
class Novelty:
    """The novelty of one test frame, (H, W) each; NaN where the posed hand is not drawn."""

    #: Index of the frame.
    frame: int
    #: Angle between the normal and the nearest normal of the same place in a training frame,
    #: degrees; 180 where no training frame shows the place.
    angle: np.ndarray
    #: Share of the training frames that show the place, 0 to 1.
    seen: np.ndarray


def measure_novelty(capture: Capture, split: Split, frames: Sequence[int]) -> Iterator[Novelty]:
    """Compare test frames with the training frames.

    Hands are where the truth has them, or the estimates where the capture knows no truth. A
    training frame shows a place where its given mask has a pixel of it.

    Args:
        capture: the capture.
        split: says which frames train.
        frames: indices of the frames to compare.

    Raises:
        BadInput: the hand template that is installed is not the capture's.
    """
    surfaces = HandSurfaces({side: capture.template(side) for side in capture.info.sides}, PATCH)
    hands = capture.true_hands or capture.hands
    valid = np.all([hand.valid for hand in hands.values()], axis=0)
    train = split.train[valid[split.train]]
    count = len(surfaces.cell_normals)
    normals = np.zeros((len(train), count, 3), dtype=np.float32)
    for row, footprint in enumerate(_footprints(surfaces, capture, train)):
        shown = hand_pixels(capture.mask(int(train[row]))).reshape(-1)[footprint.pixels]
        normals[row] = _mean_normals(footprint.cells[shown], footprint.normals[shown], count)
    known = (normals != 0.0).any(axis=2)
    share = known.mean(axis=0) if len(train) else np.zeros(count)
    test = np.array(frames, dtype=np.int64)
    for frame, footprint in zip(frames, _footprints(surfaces, capture, test), strict=True):
        cells = np.unique(footprint.cells)
        mine = _mean_normals(footprint.cells, footprint.normals, count)[cells]
        nearest = np.full(len(cells), -1.0)
        for start in range(0, len(train), _CHUNK):
            part = slice(start, start + _CHUNK)
            cosines = np.einsum("fck,ck->fc", normals[part][:, cells], mine)
            cosines[~known[part][:, cells]] = -1.0
            nearest = np.maximum(nearest, cosines.max(axis=0))
        place = np.searchsorted(cells, footprint.cells)
        angle, seen = (np.full(capture.size, np.nan) for _ in range(2))
        degrees = np.degrees(np.arccos(np.clip(nearest, -1.0, 1.0)))
        angle.reshape(-1)[footprint.pixels] = degrees[place]
        seen.reshape(-1)[footprint.pixels] = share[footprint.cells]
        yield Novelty(frame, angle, seen)


def _footprints(
    surfaces: HandSurfaces, capture: Capture, frames: np.ndarray
) -> Iterator[Footprint]:
    cameras = capture.cameras
    return surfaces.footprints(
        capture.true_hands or capture.hands, cameras.Ks, cameras.viewmats, frames, capture.size
    )


def _mean_normals(cells: np.ndarray, normals: np.ndarray, count: int) -> np.ndarray:
    """(C, 3) float32 unit mean normal of each cell; zeros where no pixel shows it."""
    sums = np.stack([np.bincount(cells, normals[:, k], count) for k in range(3)], axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    unit: np.ndarray = np.where(length > 1e-6, sums / np.maximum(length, 1e-6), 0.0)
    return unit.astype(np.float32)
