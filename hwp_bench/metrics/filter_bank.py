"""A fixed bank of oriented filters: how strong edges and lines are, in which direction.

Second derivatives of a Gaussian and their Hilbert partners, steerable to any angle from seven
separable filters (Freeman and Adelson, The design and use of steerable filters, IEEE TPAMI
13(9), 1991, tables III to VI). Even and odd responses together give the energy, which does not
change where inside a wave the pixel sits: a structure that moves by a fraction of its own width
stays nearly the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

#: Taps of every one-dimensional filter, and their distance in widths of the Gaussian.
TAPS, SPACING = 9, 0.67
#: Directions of the energies: 0, 45, 90 and 135 degrees.
ORIENTATIONS = 4
#: Binomial low-pass before every second pixel is taken for the next scale.
BINOMIAL = np.array([1, 4, 6, 4, 1], np.float32) / 16.0


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
    return np.sqrt(np.square(even) + np.square(odd))


def local_mean(image: np.ndarray) -> np.ndarray:
    """Gaussian mean (standard deviation 2 px, 13 taps) of (H, W, C) float32; black beyond."""
    kernel = cv2.getGaussianKernel(13, 2.0, cv2.CV_32F)
    return _separable(image, kernel, kernel)


def half_size(image: np.ndarray) -> np.ndarray:
    """The next coarser scale of (H, W) or (H, W, C) float32: low-pass, every second pixel."""
    return np.ascontiguousarray(_separable(image, BINOMIAL, BINOMIAL)[::2, ::2])


def _separable(image: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(image, cv2.CV_32F, along_x, along_y, borderType=cv2.BORDER_CONSTANT)
