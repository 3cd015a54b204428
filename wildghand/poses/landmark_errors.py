"""The form of a pose's errors: which joints err together, where an estimator goes by landmarks."""

from __future__ import annotations

import numpy as np

from hwp_bench.hands import HandParameters, HandTemplate
from hwp_bench.hands.articulation import right_jacobian
from hwp_bench.hands.poses import (
    DEGREES,
    PosedSkeleton,
    hand_extent,
    landmark_rows,
    posed_skeleton,
    rest_skeleton,
)
from wildghand.poses.settings import PoseSettings

# A landmark nearer to the camera says nothing of where it lies in the image, m.
_NEAREST = 0.01


def in_front(template: HandTemplate, hand: HandParameters, viewmats: np.ndarray) -> np.ndarray:
    """(F,) bool: in which frames a camera sees all landmarks of a hand; see `pose_covariances`."""
    landmarks = _seen(template, hand, viewmats).landmarks
    return np.asarray((landmarks[..., 2] > _NEAREST).all(axis=1))


def extent_in(template: HandTemplate, hand: HandParameters, viewmats: np.ndarray) -> float:
    """How large a hand is in the image, by which landmarks err; see `pose_covariances`.

    Returns:
        Median over frames of the larger side of its box, in slopes of the camera.
    """
    return hand_extent(_seen(template, hand, viewmats).landmarks)


def pose_covariances(
    template: HandTemplate,
    hand: HandParameters,
    viewmats: np.ndarray,
    extent: float,
    settings: PoseSettings,
) -> np.ndarray:
    """Covariance of the errors of each frame's pose, up to a factor that all frames share.

    A pose that is fitted to 21 landmarks, in the image and in space, answers to their errors to
    first order by least squares next to what the estimator expects. So a joint errs where landmarks
    say little of it, and the joints of a finger make up for each other.

    Args:
        template: of the hand.
        hand: given parameters of F frames, in front of the cameras.
        viewmats: (F, 4, 4) world to camera.
        extent: of the hand in the clip, by `extent_in`: all its frames have one.
        settings: errors of landmarks, and what is expected.

    Returns:
        (F, 51, 51): 16 joints about their own axes, rad, then the place in camera axes, m.
    """
    posed = _seen(template, hand, viewmats)
    rows = landmark_rows(posed, settings.image_error * extent, settings.space_error)
    told = np.einsum("fnk,fnl->fkl", rows, rows)
    turn, shift = settings.expected_turn, settings.expected_shift
    expected = np.repeat([turn, shift], [DEGREES - 3, 3]) ** -2.0
    answer = np.linalg.inv(told + np.diag(expected))
    return np.asarray(answer @ told @ answer)


def _seen(template: HandTemplate, hand: HandParameters, viewmats: np.ndarray) -> PosedSkeleton:
    """The skeleton of a hand in camera axes."""
    rest = rest_skeleton(template, hand.betas)
    return posed_skeleton(rest, hand.pose, hand.transl).seen_by(viewmats)


def vector_changes(pose: np.ndarray) -> np.ndarray:
    """How rotation vectors change with small turns about the joints' own axes.

    Args:
        pose: (..., 3) axis-angle, rad, of at most half a turn.

    Returns:
        (..., 3, 3): the vector of R(v) exp(d) is v plus this times d, to first order.

    Source: the inverse of the right Jacobian of SO(3), Sola et al. 2018, eq. 144.
    """
    return np.asarray(np.linalg.inv(right_jacobian(pose)))
