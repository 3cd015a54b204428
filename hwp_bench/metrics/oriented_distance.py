"""Oriented distance: a perceptual distance that needs no downloaded weights. It is not LPIPS.

Its form is that of LPIPS (channels normalised at every pixel, differences squared, averaged
over space and scales), but the channels are a fixed bank of oriented filters and local means
instead of a trained network: it knows edges, texture, brightness and colour, and nothing of
what an image shows. `docs/protocol.md` prints how it orders degradations next to SSIM.

The filters are second derivatives of a Gaussian and their Hilbert partners, steerable to any angle
from seven separable filters (Freeman and Adelson, The design and use of steerable filters, IEEE
TPAMI 13(9), 1991, tables III to VI). Even and odd responses together give the energy, which does
not change where inside a wave the pixel sits: a structure that moves by a fraction of its own width
stays nearly the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from hwp_bench.base.colors import LUMA
from hwp_bench.metrics.pixels import bounding_box, check_same_shape, composite, crop
from hwp_bench.metrics.protocol import HWP_V1

#: Number of scales; each has half the resolution of the one before.
SCALES = 4
#: Weight of an oriented energy relative to the local means in the vector that is normalised: it
#: sets how much texture counts against brightness and colour.
CONTRAST_GAIN = 12.0
#: Taps of every one-dimensional filter, and their distance in widths of the Gaussian.
TAPS, SPACING = 9, 0.67
#: Directions of the energies: 0, 45, 90 and 135 degrees.
ORIENTATIONS = 4
#: Binomial low-pass before every second pixel is taken for the next scale.
BINOMIAL = np.array([1, 4, 6, 4, 1], np.float32) / 16.0


def oriented_distance(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    padding: int = HWP_V1.box_padding,
) -> float:
    """Distance of two images on the pixels of `mask`, both black outside it.

    On each of four scales every pixel gets a vector of ten channels, none negative: the local
    mean m of red, green and blue and its complement 1 - m, each divided by sqrt(3), and the
    energy of brightness in four directions, times `CONTRAST_GAIN`. Vectors are brought to
    length 1; half the squared difference of the two images' vectors is averaged over the mask
    (weighted by its share of the pixel at that scale), then over the scales.

    Args:
        prediction: (H, W, 3) float in [0, 1], sRGB.
        target: (H, W, 3) float in [0, 1], sRGB.
        mask: (H, W) bool, the scored pixels.
        padding: pixels that the mask's box is grown by.

    Returns:
        0 for identical images, at most 1 (black against white); symmetric. Filters run in
        float32, means in float64.

    Raises:
        ShapeMismatch: the three do not describe the same image.
        EmptyMask: no pixel to score.

    Source: `docs/protocol.md`; the form follows Zhang et al., CVPR 2018, equation 1.
    """
    check_same_shape(prediction, target, mask)
    box = bounding_box(mask).grown(padding)
    x, y = (crop(composite(image, mask), box).astype(np.float32) for image in (prediction, target))
    weight = crop(mask, box).astype(np.float32)
    total = _scale_distance(x, y, weight)
    for _ in range(SCALES - 1):
        x, y, weight = half_size(x), half_size(y), half_size(weight)
        total += _scale_distance(x, y, weight)
    return total / SCALES


def _scale_distance(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> float:
    """Half the squared difference of the unit vectors, mean over `weight` (H, W).

    |f/|f| - g/|g||^2 = (|f - g|^2 - (|f| - |g|)^2) / (|f| |g|), which is exactly 0 for f = g.
    """
    x_vector, y_vector = _vector(x), _vector(y)
    x_length, y_length = np.sqrt(_squared_length(x_vector)), np.sqrt(_squared_length(y_vector))
    difference = _squared_length([a - b for a, b in zip(x_vector, y_vector, strict=True)])
    angular = (difference - (x_length - y_length) ** 2) / (x_length * y_length)
    per_pixel = np.maximum(angular, 0.0).astype(np.float64)
    return float(np.sum(per_pixel * weight) / (2.0 * weight.sum(dtype=np.float64)))


def _vector(image: np.ndarray) -> list[np.ndarray]:
    """The channels of every pixel at one scale, as groups (H, W, 3 or 4), none negative.

    The means and their complements have a length of at least 1 / sqrt(2).
    """
    share = np.float32(1.0 / np.sqrt(3.0))
    mean = share * local_mean(image)
    luma = CONTRAST_GAIN * np.array([LUMA], np.float32)
    return [mean, share - mean, oriented_energies(cv2.transform(image, luma))]


def _squared_length(groups: list[np.ndarray]) -> np.ndarray:
    """Sum of squares over all channels of all groups: (H, W) float32."""
    # Whole planes are added: OpenCV's sum over four channels takes twice as long.
    total = np.zeros(groups[0].shape[:2], np.float32)
    for group in groups:
        first, *others = cv2.split(group * group)
        for plane in others:
            first += plane
        total += first
    return total


@dataclass(frozen=True, eq=False)
class FilterBank:
    """One-dimensional kernels (TAPS,) float32, and how their products are steered."""

    #: Kernels along x and y of the even basis: xx, xy, yy.
    even: tuple[tuple[np.ndarray, np.ndarray], ...]
    #: Kernels along x and y of the odd basis: xxx, xxy, xyy, yyy.
    odd: tuple[tuple[np.ndarray, np.ndarray], ...]
    #: (ORIENTATIONS, 3) float32: the even response in each direction from the even basis.
    even_steering: np.ndarray
    #: (ORIENTATIONS, 4) float32: the odd response in each direction from the odd basis.
    odd_steering: np.ndarray


@lru_cache(maxsize=1)
def filter_bank() -> FilterBank:
    """The bank, built once.

    Both filters are scaled so that a sine wave of amplitude 1 in their preferred direction and
    frequency has a response of amplitude 1; the even one answers 0 to a constant image.
    """
    t = (np.arange(TAPS) - TAPS // 2) * SPACING
    gauss = np.exp(-t * t)
    slope = t * gauss
    even = (2.0 * t * t - 1.0) * gauss
    even -= gauss * even.sum() / gauss.sum()
    odd = (t**3 - 2.254 * t) * gauss
    cross = (t * t - 0.7515) * gauss
    waves = np.exp(-1j * np.outer(np.linspace(0.0, np.pi, 512), np.arange(TAPS)))
    even_peak, odd_peak = (np.abs(waves @ kernel).max() * gauss.sum() for kernel in (even, odd))
    angles = np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS
    c, s = np.cos(angles), np.sin(angles)
    even_steering = np.stack([c * c, -4 * c * s, s * s], axis=1) / even_peak
    odd_steering = np.stack([c**3, -3 * c * c * s, 3 * c * s * s, -(s**3)], axis=1) / odd_peak
    g, d, e, o, x = (k.astype(np.float32) for k in (gauss, slope, even, odd, cross))
    return FilterBank(
        even=((e, g), (d, d), (g, e)),
        odd=((o, g), (x, d), (d, x), (g, o)),
        even_steering=even_steering.astype(np.float32),
        odd_steering=odd_steering.astype(np.float32),
    )


def oriented_energies(plane: np.ndarray) -> np.ndarray:
    """Amplitude of the oriented structure around every pixel; black beyond the border.

    Args:
        plane: (H, W) float32.

    Returns:
        (H, W, ORIENTATIONS) float32, not negative.
    """
    bank = filter_bank()
    even_basis = cv2.merge([_separable(plane, *kernels) for kernels in bank.even])
    odd_basis = cv2.merge([_separable(plane, *kernels) for kernels in bank.odd])
    even = cv2.transform(even_basis, bank.even_steering)
    odd = cv2.transform(odd_basis, bank.odd_steering)
    # Not cv2.magnitude: its last bit depends on where in memory the arrays happen to lie.
    np.square(even, out=even)
    even += np.square(odd, out=odd)
    return np.sqrt(even, out=even)


def local_mean(image: np.ndarray) -> np.ndarray:
    """Gaussian mean (standard deviation 2 px, 13 taps) of (H, W, C) float32; black beyond."""
    kernel = cv2.getGaussianKernel(13, 2.0, cv2.CV_32F)
    return _separable(image, kernel, kernel)


def half_size(image: np.ndarray) -> np.ndarray:
    """The next coarser scale of (H, W) or (H, W, C) float32: low-pass, every second pixel."""
    return np.ascontiguousarray(_separable(image, BINOMIAL, BINOMIAL)[::2, ::2])


def _separable(image: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(image, cv2.CV_32F, along_x, along_y, borderType=cv2.BORDER_CONSTANT)
