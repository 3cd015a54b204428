"""The score of an avatar without any error of its own at the poses that methods are given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hwp_bench.capture import Capture
from hwp_bench.capture.schema import TRUE_TEMPLATE, read_subject_mesh
from hwp_bench.evaluation.budget.pair import Pair, error_of
from hwp_bench.evaluation.budget.surface import MovingSurface
from hwp_bench.hands import HandTemplate
from hwp_bench.metrics.pixels import decibels

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


@dataclass(frozen=True, eq=False)
class Ceiling:
    """The score of an avatar without an error of its own, on a capture that knows the truth."""

    #: The capture.
    capture: Capture
    #: Rest hands of its subject, by side.
    templates: Mapping[str, HandTemplate]

    @classmethod
    def of(cls, capture: Capture) -> Ceiling | None:
        """The ceiling of a capture; None where it does not know the true poses."""
        return None if capture.true_hands is None else cls(capture, surfaces_of(capture))

    def psnr(self, frame: int, pair: Pair | None, score: float) -> float:
        """PSNR of `at_given_poses`, dB.

        Args:
            frame: which test frame.
            pair: its truth, next to what the method drew; None where that cannot be scored.
            score: of the method, which holds where there is no pair or no estimate of the hands.
        """
        if pair is None:
            return score
        moved = at_given_poses(self.capture, frame, self.templates)
        return score if moved is None else decibels(error_of(moved, pair))
