"""The places of the skin that the pixels of training frames show, by the given parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.anchors import HandSurfaces
from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.training import TrainingFrames

#: Edge of a place, m on the rest hand: about half a segment of a finger.
PLACE = 0.01


def skin_places(
    training: TrainingCapture, frames: TrainingFrames, templates: Mapping[str, HandTemplate]
) -> list[np.ndarray]:
    """Number the places of a hand, and say which of them each pixel shows.

    Args:
        training: parameters and cameras of the frames.
        frames: R frames.
        templates: of the person's hands, by side.

    Returns:
        R times (H, W) uint16: 0 where the posed hands are not, else the place, numbered without
        gaps over all frames.
    """
    surfaces = HandSurfaces(templates, PLACE)
    size = (training.height, training.width)
    cameras = training.cameras
    shown = np.zeros(len(surfaces.cell_normals) + 1, dtype=bool)
    shown[0] = True
    found = []
    for drawn in surfaces.footprints(
        training.hands, cameras.Ks, cameras.viewmats, frames.indices, size
    ):
        places = np.zeros(size[0] * size[1], dtype=np.int32)
        places[drawn.pixels] = drawn.cells + 1
        shown[drawn.cells + 1] = True
        found.append(places)
    numbers = (np.cumsum(shown) - 1).astype(np.uint16)
    return [numbers[places].reshape(size) for places in found]
