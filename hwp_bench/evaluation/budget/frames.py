"""Test frames with their predictions, their truth and the normals of the posed hands."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hwp_bench.capture import Capture
from hwp_bench.evaluation.budget.pair import Pair
from hwp_bench.evaluation.budget.surface import MovingSurface
from hwp_bench.evaluation.scoring import read_prediction
from hwp_bench.hands.anchors import HandSurfaces
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1

# Edge of the cells of the surface, m; normals do not depend on it.
_PATCH = 0.004


def pairs_of(
    capture: Capture, predictions: Path, frames: list[int]
) -> Iterator[tuple[int, Pair | None]]:
    """Read the predictions of some test frames next to their truth.

    Args:
        capture: with true hands where it knows them; else the estimates give the normals. The
            surface that moves is always that of the estimates, which the method was given.
        predictions: folder of the predicted frames.
        frames: indices, ascending.

    Yields:
        The frame's index and the pair; None where the prediction cannot be scored.
    """
    templates = {side: capture.template(side) for side in capture.info.sides}
    surfaces = HandSurfaces(templates, _PATCH)
    drawn = surfaces.footprints(
        capture.true_hands or capture.hands,
        capture.cameras.Ks,
        capture.cameras.viewmats,
        np.array(frames),
        capture.size,
    )
    for frame, footprint in zip(frames, drawn, strict=True):
        found = read_prediction(predictions, frame, capture.size)
        if found.pixels is None:
            yield frame, None
            continue
        mask, exact = capture.scoring_mask(frame)
        normals = np.zeros((*capture.size, 3))
        normals.reshape(-1, 3)[footprint.pixels] = footprint.normals
        shown = {
            side: hand.at(frame, side) for side, hand in capture.hands.items() if hand.valid[frame]
        }
        camera = capture.cameras.camera(frame, capture.info.width, capture.info.height)
        yield (
            frame,
            Pair(
                prediction=found.pixels / 255.0,
                target=capture.frame(frame) / 255.0,
                region=scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact),
                normals=normals,
                surface=MovingSurface(templates, shown, camera) if shown else None,
            ),
        )
