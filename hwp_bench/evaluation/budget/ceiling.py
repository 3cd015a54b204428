"""The score of an avatar without any error of its own at the poses that methods are given."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hwp_bench.capture import Capture
from hwp_bench.capture.schema import TRUE_TEMPLATE
from hwp_bench.capture.subject_mesh import read_subject_mesh
from hwp_bench.evaluation.budget.surface import MovingSurface
from hwp_bench.hands import HandTemplate
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.psnr_ssim import decibels, squared_error

#: Name of its row, and what it is.
NAME = "true colours"
TEXT = "the true frame moved to the given poses: an avatar without an error of its own"


def surfaces_of(capture: Capture) -> dict[str, HandTemplate]:
    """The subject's own rest hands where the capture holds them, else the hand model."""
    own = capture.root / TRUE_TEMPLATE
    models = {side: capture.template(side) for side in capture.info.sides}
    if not own.is_file():
        return models
    return {side: read_subject_mesh(own, model) for side, model in models.items()}


def at_given_poses(
    capture: Capture, frame: int, templates: Mapping[str, HandTemplate]
) -> np.ndarray | None:
    """A true frame whose hands are moved from their true poses to the estimated ones.

    Each pixel of the moved surface takes its colour from where its point is in the true frame;
    pixels next to it follow the nearest one on it.

    Args:
        capture: with true hands.
        frame: which.
        templates: of the subject, as `surfaces_of`.

    Returns:
        (H, W, 3) in [0, 1]; None where the truth is not known, or a hand was not estimated.
    """
    truth = capture.true_hands
    if truth is None or not all(hand.valid[frame] for hand in capture.hands.values()):
        return None
    true = {side: hand.at(frame, side) for side, hand in truth.items()}
    given = {side: capture.hands[side].at(frame, side) for side in true}
    camera = capture.cameras.camera(frame, capture.info.width, capture.info.height)
    change = []
    for side, hand in true.items():
        turn = Rotation.from_rotvec(given[side].pose) * Rotation.from_rotvec(hand.pose).inv()
        change += [turn.as_rotvec().ravel(), given[side].transl - hand.transl]
    sources = MovingSurface(templates, true, camera).sources(np.concatenate(change))
    image = capture.frame(frame).astype(np.float32) / 255.0
    moved: np.ndarray = cv2.remap(image, sources[..., 0], sources[..., 1], cv2.INTER_LINEAR)
    return moved


def ceiling(capture: Capture, scores: Mapping[int, float]) -> dict[int, float] | None:
    """PSNR of `at_given_poses` in test frames, dB.

    Args:
        capture: which.
        scores: of the method in these frames, which hold where the hand was not estimated.

    Returns:
        By frame; None where the capture does not know the truth.
    """
    if capture.true_hands is None:
        return None
    templates, found = surfaces_of(capture), {}
    for frame, score in scores.items():
        moved = at_given_poses(capture, frame, templates)
        if moved is None:
            found[frame] = score
            continue
        mask, exact = capture.scoring_mask(frame)
        region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        error = squared_error(moved, capture.frame(frame) / 255.0)[region].mean()
        found[frame] = decibels(float(error))
    return found
