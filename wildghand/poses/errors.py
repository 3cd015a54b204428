"""The errors of given poses and the spread of true ones, both estimated from the given poses alone.

The form of the errors, which joints err together, is that of an estimator that goes by landmarks.
Their size and the spread follow by factor analysis: a given pose is a true one, which comes from a
normal distribution, plus an error whose covariance is known for each frame up to a factor.
"""

from __future__ import annotations

from dataclasses import dataclass

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

# Error of a landmark in the image, as a share of the hand's extent, and in space against the hand's
# centre, along each axis, m. They state the form of the poses' errors, not their size.
_IMAGE_ERROR, _SPACE_ERROR = 0.01, 0.005
# What estimators expect before they see landmarks: of a joint, rad about each axis, and of the
# hand's place, m along each axis.
_EXPECTED_TURN, _EXPECTED_SHIFT = 0.5, 0.01
# A landmark nearer to the camera says nothing of where it lies in the image, m.
_NEAREST = 0.01


def in_front(template: HandTemplate, hand: HandParameters, viewmats: np.ndarray) -> np.ndarray:
    """(F,) bool: in which frames a camera sees all landmarks of a hand; see `pose_covariances`."""
    landmarks = _seen(template, hand, viewmats).landmarks
    return np.asarray((landmarks[..., 2] > _NEAREST).all(axis=1))


def extent_in(template: HandTemplate, hand: HandParameters, viewmats: np.ndarray) -> float:
    """How large a hand is in the image, by which landmarks err; see `pose_covariances`."""
    return hand_extent(_seen(template, hand, viewmats).landmarks)


def pose_covariances(
    template: HandTemplate,
    hand: HandParameters,
    viewmats: np.ndarray,
    extent: float,
) -> np.ndarray:
    """Covariance of the errors of each frame's pose, up to a factor that all frames share.

    A pose that is fitted to 21 landmarks, in the image and in space, answers to their errors to
    first order by least squares next to what the estimator expects. So joints have large errors
    where landmarks constrain them little, and the joints of a finger compensate each other.

    Args:
        viewmats: (F, 4, 4) world to camera.

    Returns:
        (F, 51, 51): 16 joints about their own axes, rad, then the place in camera axes, m.
    """
    posed = _seen(template, hand, viewmats)
    rows = landmark_rows(posed, _IMAGE_ERROR * extent, _SPACE_ERROR)
    told = np.einsum("fnk,fnl->fkl", rows, rows)
    turn, shift = _EXPECTED_TURN, _EXPECTED_SHIFT
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


# Smallest variance relative to the largest that a covariance keeps, so that it can be inverted.
_LEAST = 1e-9


@dataclass(frozen=True, eq=False)
class PoseSpread:
    """The distribution of true poses of D numbers."""

    #: (D,).
    mean: np.ndarray
    #: (D, D).
    covariance: np.ndarray

    def expected(self, poses: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """The true poses that are expected behind given ones.

        Args:
            poses: (F, D) given.
            errors: (F, D, D) covariance of the errors of each.

        Returns:
            (F, D), the means of the true poses' distributions.
        """
        off = poses - self.mean
        gain = np.linalg.solve(_invertible(self.covariance + errors), off[..., None])[..., 0]
        return np.asarray(self.mean + gain @ self.covariance)


def error_size(poses: np.ndarray, errors: np.ndarray) -> float:
    """Estimate the factor on the standard deviations of errors that explains the given poses best.

    In units of the mean covariance of the errors, true poses spread along a few directions and
    errors along all. How many directions are of the poses, q of D, is chosen by the Bayesian
    information criterion; the mean variance of the others is that of the errors.

    Args:
        poses: (F, D) given; with F at most D nothing can be estimated.
        errors: (F, D, D) covariances.

    Returns:
        The factor; 0 where nothing can be estimated.

    Source: probabilistic PCA, Tipping and Bishop 1999, eq. 7 and 8; BIC, Schwarz 1978.
    """
    count, width = poses.shape
    if count <= width + 1:
        return 0.0
    values, vectors = np.linalg.eigh(_invertible(errors.mean(axis=0)))
    off = (poses - poses.mean(axis=0)) @ (vectors / np.sqrt(values))
    spread = np.maximum(np.linalg.eigvalsh(off.T @ off / count)[::-1], _LEAST**2)
    kept = np.arange(1, width - 1)
    # Of the directions beyond the first q: their mean variance.
    beyond = (spread.sum() - np.cumsum(spread))[kept - 1] / (width - kept)
    beyond = np.maximum(beyond, _LEAST**2)
    fit = -0.5 * count * (np.cumsum(np.log(spread))[kept - 1] + (width - kept) * np.log(beyond))
    free = width * kept - 0.5 * kept * (kept - 1) + 1
    best = int(np.argmax(fit - 0.5 * free * np.log(count)))
    # Each direction of the poses takes up a share of the errors of its F frames.
    return float(np.sqrt(beyond[best] * count / (count - 1 - kept[best])))


def spread_of(poses: np.ndarray, errors: np.ndarray, rounds: int) -> PoseSpread:
    """The distribution of true poses that explains the given ones best.

    Args:
        poses: (F, D) given.
        errors: (F, D, D) covariances of their errors.
        rounds: of expectation maximization, which starts with what the given poses have more than
            their errors.

    Source: expectation maximization, Dempster et al. 1977, for normal data of known errors.
    """
    values, vectors = np.linalg.eigh(np.cov(poses.T, bias=True) - errors.mean(axis=0))
    least = 0.01 * np.abs(values).max()
    found = PoseSpread(np.median(poses, axis=0), (vectors * np.maximum(values, least)) @ vectors.T)
    for _ in range(rounds):
        seen = np.linalg.inv(_invertible(found.covariance + errors))
        mean = np.linalg.solve(seen.sum(axis=0), np.einsum("fij,fj->i", seen, poses))
        off = np.einsum("fij,fj->fi", seen, poses - mean) @ found.covariance
        unsure = found.covariance - found.covariance @ seen.mean(axis=0) @ found.covariance
        covariance = off.T @ off / len(poses) + unsure
        found = PoseSpread(mean, 0.5 * (covariance + covariance.T))
    return found


def _invertible(covariance: np.ndarray) -> np.ndarray:
    """Covariances (..., D, D), with a share of their mean variance on each diagonal."""
    width = covariance.shape[-1]
    mean = np.trace(covariance, axis1=-2, axis2=-1)[..., None, None] / width
    return covariance + (1e-6 * mean + 1e-30) * np.eye(width)
