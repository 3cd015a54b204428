"""How true poses spread and how large their errors are, both told by the given poses alone.

The model is that of factor analysis: a given pose is a true one, which comes from a normal
distribution, plus an error whose covariance is known for each frame up to a factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
    """Factor on the standard deviations of errors with which they explain the given poses best.

    In units of the mean covariance of the errors, true poses spread along a few directions and
    errors along all. How many directions are of the poses, q of D, is chosen by the Bayesian
    information criterion; the mean variance of the others is that of the errors.

    Args:
        poses: (F, D) given; with F not above D nothing can be told.
        errors: (F, D, D) covariances.

    Returns:
        The factor; 0 where nothing can be told.

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
