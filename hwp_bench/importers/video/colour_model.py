"""The colours of the hand and of its surroundings, learnt once over the whole clip."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

#: Pixels of each kind that the model is learnt from; more do not change it.
SAMPLES = 40_000
#: Standard deviation (8-bit levels) that is added to every colour. A plain wall is nearly one
#: colour: a pixel in which video coding has smeared a trace of skin is then a hundred deviations
#: from the wall and called skin. With a common spread the border lies half way.
SPREAD = 4.0
#: Width of the image that the samples are laid out in.
_STRIP = 400
# Colours within so many standard deviations are the same.
_SAME_COLOUR = 2.0
# Colours of a mixture that have less weight than this are noise.
_LEAST_WEIGHT = 0.01
# Bits of a channel whose evidence is computed: neighbours share it.
_BITS = 7
# Where the nine covariance entries of each of the five colours lie in a mixture.
_COVARIANCES = slice(20, 65)


@dataclass(frozen=True, eq=False)
class ColourModel:
    """Two Gaussian mixtures of five colours each, in OpenCV's GrabCut layout.

    Attributes:
        background: (1, 65) float64.
        foreground: (1, 65) float64.
    """

    background: np.ndarray
    foreground: np.ndarray

    def sharpened(self, weight: float) -> ColourModel:
        """Return a copy whose log densities vary `weight` times as much (covariances shrink)."""
        background, foreground = self.background.copy(), self.foreground.copy()
        for mixture in (background, foreground):
            mixture[:, _COVARIANCES] /= weight
        return ColourModel(background, foreground)


def learn_colours(
    samples: Iterable[tuple[np.ndarray, np.ndarray]], seed: int = 0
) -> ColourModel | None:
    """Learn the mixtures from labelled pixels of all frames.

    Args:
        samples: for each frame the colours (N, 3) uint8 of pixels that are hand, and of pixels
            that are not.
        seed: of the choice of pixels and of the clustering.

    Returns:
        The model, or None where one of the two kinds has fewer than 100 pixels.
    """
    import cv2

    random = np.random.default_rng(seed)
    kinds: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for sample in samples:
        for pixels, found in zip(kinds, sample, strict=True):
            # A thousand of each frame, so that every frame counts and memory is bounded.
            pixels.append(found[random.integers(0, len(found), 1000)] if len(found) else found)
    hand, other = (np.concatenate([np.zeros((0, 3), np.uint8), *pixels]) for pixels in kinds)
    if min(len(hand), len(other)) < 100:
        return None
    cv2.setRNGSeed(seed)
    model = _mixtures(hand, other, random)
    # The silhouette also covers objects in the hand. Colours that also occur next to the hand
    # are therefore not learnt as hand. (A hand before skin-coloured things is not harmed.)
    elsewhere = _least_distance(hand, model.background) < _SAME_COLOUR**2
    if 0.0 < elsewhere.mean() < 0.5:
        model = _mixtures(hand[~elsewhere], other, random)
    return model


def _mixtures(hand: np.ndarray, other: np.ndarray, random: np.random.Generator) -> ColourModel:
    """Five Gaussians for each of two sets of colours (N, 3) uint8."""
    import cv2

    chosen = [colours[random.integers(0, len(colours), SAMPLES)] for colours in (hand, other)]
    strip = np.concatenate(chosen).reshape(-1, _STRIP, 3)
    labels = np.repeat([cv2.GC_FGD, cv2.GC_BGD], SAMPLES).reshape(-1, _STRIP).astype(np.uint8)
    background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(strip, labels, (0, 0, 1, 1), background, foreground, 3, cv2.GC_INIT_WITH_MASK)
    for mixture in (background, foreground):
        mixture[:, _COVARIANCES] += np.tile((SPREAD**2 * np.eye(3)).ravel(), 5)
    return ColourModel(background, foreground)


def evidence(image: np.ndarray, model: ColourModel) -> np.ndarray:
    """Log of (likelihood as hand / likelihood as surroundings) for every pixel.

    Args:
        image: (S, S, 3) uint8, in the colour space that the model was learnt in.
        model: the mixtures.

    Returns:
        (S, S) float32.
    """
    packed = _packed(image)
    seen = np.zeros(1 << 3 * _BITS, dtype=bool)
    seen[packed] = True
    colours = np.flatnonzero(seen)
    # The middle of each cell, as it is when the lowest bit is set.
    channels = [(colours >> shift) & ((1 << _BITS) - 1) for shift in (2 * _BITS, _BITS, 0)]
    table = (2.0 * np.stack(channels, axis=1) + 1.0).astype(float)
    value = _log_density(table, model.foreground) - _log_density(table, model.background)
    by_colour = np.empty(len(seen), dtype=np.float32)
    by_colour[colours] = value
    return by_colour[packed]


def _packed(image: np.ndarray) -> np.ndarray:
    """Colours (S, S) as one number each, at half the resolution of each channel."""
    coarse = image.astype(np.int32) >> 1
    return (coarse[..., 0] << 2 * _BITS) | (coarse[..., 1] << _BITS) | coarse[..., 2]


def _least_distance(colours: np.ndarray, mixture: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distance (N,) to the nearest Gaussian of a mixture."""
    means = mixture[0, 5:20].reshape(5, 3)
    covariances = mixture[0, _COVARIANCES].reshape(5, 3, 3)
    least = np.full(len(colours), np.inf)
    for k in np.flatnonzero(mixture[0, :5] >= _LEAST_WEIGHT):
        offset = colours - means[k]
        inverse = np.linalg.inv(covariances[k])
        np.minimum(least, np.einsum("ni,ij,nj->n", offset, inverse, offset), out=least)
    return least


def _log_density(colours: np.ndarray, mixture: np.ndarray) -> np.ndarray:
    weights = mixture[0, :5]
    means = mixture[0, 5:20].reshape(5, 3)
    covariances = mixture[0, _COVARIANCES].reshape(5, 3, 3)
    total = np.full(len(colours), 1e-30)
    for weight, mean, covariance in zip(weights, means, covariances, strict=True):
        if weight <= 0:
            continue
        offset = colours - mean
        distance = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance), offset)
        total += weight * np.exp(-0.5 * distance) / np.sqrt(np.linalg.det(covariance))
    return np.log(total)
