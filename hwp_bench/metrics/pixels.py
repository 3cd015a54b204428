"""The formulas of scoring: which pixels, PSNR, SSIM (Wang et al., 2004), oriented distance.

Images are 8-bit sRGB, (H, W, 3), and all of one size.

The oriented distance is a perceptual distance that needs no downloaded weights. It is not LPIPS.
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

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from hwp_bench.base.colors import LUMA
from hwp_bench.base.errors import BadImage, BadPrediction, EmptyMask, ShapeMismatch
from hwp_bench.base.kernels import compiled
from hwp_bench.metrics.protocol import HWP_V1, PAPER_WILDGHAND, PSNR_CAP, SsimSettings

#: A mask value above this means "hand".
MASK_THRESHOLD = 127


def check_truth(target: np.ndarray, mask: np.ndarray) -> None:
    """Refuse a target, (H, W, 3) uint8, and mask, (H, W), that cannot be scored against."""
    if target.dtype != np.uint8:
        raise BadImage(f"the target is {target.dtype}, not uint8", field="target")
    if target.ndim != 3 or target.shape[2] != 3 or target.size == 0:
        raise ShapeMismatch(f"the target is {target.shape}, not (H, W, 3)", field="target")
    if mask.dtype not in (np.uint8, np.bool_):
        raise BadImage(f"the mask is {mask.dtype}, not uint8 or bool", field="mask")
    if mask.shape != target.shape[:2]:
        raise ShapeMismatch(
            f"the mask is {mask.shape}, the target {target.shape[:2]}", field="mask"
        )


def check_prediction(prediction: np.ndarray, target: np.ndarray) -> None:
    """Refuse a prediction that is not an image like `target`."""
    if prediction.dtype != np.uint8:
        raise BadPrediction(
            f"the prediction is {prediction.dtype}, not uint8",
            field="prediction",
            remedy="Convert float images with hwp_bench.base.images.as_uint8.",
        )
    if prediction.shape != target.shape:
        raise ShapeMismatch(
            f"the prediction is {prediction.shape}, the target {target.shape}",
            field="prediction",
            remedy="Predict at the target's own resolution, three channels.",
        )


@dataclass(frozen=True)
class Box:
    """A rectangle of pixels; it may reach beyond the frame, where everything is black."""

    #: First row.
    top: int
    #: First column.
    left: int
    #: Row after the last.
    bottom: int
    #: Column after the last.
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.bottom - self.top, self.right - self.left

    @property
    def area(self) -> int:
        """Number of pixels, those beyond the frame included."""
        rows, columns = self.shape
        return rows * columns

    def grown(self, pixels: int) -> Box:
        """The box with `pixels` more on every side."""
        return Box(self.top - pixels, self.left - pixels, self.bottom + pixels, self.right + pixels)

    def at_least(self, side: int) -> Box:
        """The box grown evenly until both sides have `side` pixels (an odd one goes below)."""
        rows, columns = (max(0, side - length) for length in self.shape)
        return Box(
            self.top - rows // 2,
            self.left - columns // 2,
            self.bottom + rows - rows // 2,
            self.right + columns - columns // 2,
        )


def hand_pixels(mask: np.ndarray) -> np.ndarray:
    """The pixels that show the hand, mixed border pixels included: (H, W) bool."""
    return mask if mask.dtype == np.bool_ else mask > MASK_THRESHOLD


def scored_pixels(mask: np.ndarray, *, erosion: int, coverage: bool = False) -> np.ndarray:
    """The pixels that the hand covers fully: (H, W) bool, may be empty.

    A quarter of the squared error otherwise sits in border pixels that mix hand and
    background, and measures the background. The mask loses `erosion` pixels at its border, to all
    eight neighbours; the frame's border takes nothing away, because the hand continues behind it.
    With `coverage` the mask says which share of a pixel the hand covers (255 = all): then the
    pixels at 255 are taken as they are, without erosion.
    """
    if coverage:
        return mask.copy() if mask.dtype == np.bool_ else mask == 255
    hand = hand_pixels(mask)
    if erosion == 0:
        return hand
    side = 2 * erosion + 1
    kernel = np.ones((side, side), np.uint8)
    return cv2.erode(hand.astype(np.uint8), kernel).astype(bool)


def can_be_scored(mask: np.ndarray, coverage: bool) -> bool:
    """Whether a mask leaves protocol hwp-v1 a pixel to score; see `scored_pixels`."""
    return bool(scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=coverage).any())


def unscorable(
    frames: Iterable[int], scoring_mask: Callable[[int], tuple[np.ndarray, bool]]
) -> Iterator[int]:
    """Yield the frames whose masks, as `Capture.scoring_mask` reads them, cannot be scored."""
    return (frame for frame in frames if not can_be_scored(*scoring_mask(frame)))


def bounding_box(region: np.ndarray) -> Box:
    """The smallest box around the True pixels of `region` (H, W) bool."""
    rows = np.flatnonzero(region.any(axis=1))
    columns = np.flatnonzero(region.any(axis=0))
    if rows.size == 0:
        raise EmptyMask(
            "no pixel is left to score",
            field="mask",
            remedy="The mask shows no hand, or a hand thinner than three pixels.",
        )
    return Box(int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1)


def crop(image: np.ndarray, box: Box) -> np.ndarray:
    """The pixels of `box`, zero (black, or False) where it leaves the frame."""
    height, width = image.shape[:2]
    out = np.zeros(box.shape + image.shape[2:], image.dtype)
    top, bottom = max(box.top, 0), min(box.bottom, height)
    left, right = max(box.left, 0), min(box.right, width)
    if top < bottom and left < right:
        inside = out[top - box.top : bottom - box.top, left - box.left : right - box.left]
        inside[...] = image[top:bottom, left:right]
    return out


def composite(image: np.ndarray, region: np.ndarray) -> np.ndarray:
    """`image` (H, W, C) where `region` (H, W) bool is True, black elsewhere; a new array."""
    return cv2.copyTo(image, region.view(np.uint8))


@compiled(nogil=True)
def similarity(
    means: tuple[np.ndarray, np.ndarray],
    squares: tuple[np.ndarray, np.ndarray],
    product: np.ndarray,
    constants: tuple[float, float, float],
) -> None:
    """SSIM of every window and channel, in place of `product`; all are (N,) float64.

    They are window means of x and y, of their squares and of x * y; constants are C1, C2, and the
    factor on variances and covariance. Variances are clamped at 0 and the covariance to what they
    allow. Source: Wang et al., 2004, equation 13.
    """
    mean_x, mean_y = means
    square_x, square_y = squares
    c1, c2, correction = constants
    twice = 2.0 * correction
    for i in range(len(product)):
        x, y = mean_x[i], mean_y[i]
        xx, yy, xy = x * x, y * y, x * y
        variance_x, variance_y = max(square_x[i] - xx, 0.0), max(square_y[i] - yy, 0.0)
        bound = np.sqrt(variance_x * variance_y)
        covariance = max(min(product[i] - xy, bound), -bound)
        numerator = (xy * 2.0 + c1) * (covariance * twice + c2)
        spread = (variance_x + variance_y) * correction + c2
        product[i] = numerator / ((xx + yy + c1) * spread)


def decibels(mse: float, cap: float = PSNR_CAP) -> float:
    """-10 log10(mse) for data range 1, at most `cap`; `cap` for mse = 0."""
    return cap if mse <= 0.0 else min(cap, -10.0 * math.log10(mse))


def squared_error(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Squared difference of two (H, W, 3) float images, mean over channels: (H, W) float64."""
    difference = np.subtract(prediction, target, dtype=np.float64)
    return np.einsum("ijk,ijk->ij", difference, difference) / difference.shape[2]


def ssim_map(x: np.ndarray, y: np.ndarray, settings: SsimSettings = HWP_V1.ssim) -> np.ndarray:
    """SSIM of every window that lies inside the image.

    Variances are clamped at 0 and the covariance to what they allow, so that rounding can
    neither leave [-1, 1] nor make identical images differ from 1.

    Args:
        x: (H, W, 3) float64, like `y`.

    Returns:
        (H - 2r, W - 2r) float64 in [-1, 1], mean over channels, r = `settings.radius`; entry
        (0, 0) belongs to the window centred on pixel (r, r).
    """
    if min(x.shape[:2]) < settings.size:
        raise ShapeMismatch(f"an image of {x.shape[:2]} is smaller than the window")
    means = [_window_mean(image, settings) for image in (x, y, x * x, y * y, x * y)]
    mean_x, mean_y, square_x, square_y, product = (mean.reshape(-1) for mean in means)
    pixels = settings.size**2
    correction = pixels / (pixels - 1) if settings.sample_covariance else 1.0
    c1 = (settings.k1 * settings.data_range) ** 2
    c2 = (settings.k2 * settings.data_range) ** 2
    similarity((mean_x, mean_y), (square_x, square_y), product, (c1, c2, correction))
    by_pixel = cv2.transform(means[-1], np.full((1, 3), 1.0 / 3.0))
    r = settings.radius
    return by_pixel[r : by_pixel.shape[0] - r, r : by_pixel.shape[1] - r]


def ssim_box(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    settings: SsimSettings = PAPER_WILDGHAND.ssim,
) -> float:
    """SSIM averaged over all windows inside the tight box of `mask`, black outside it.

    The released evaluator's form, of (H, W, 3) float in [0, 1], sRGB, and (H, W) bool. A box
    smaller than the window is grown to its size. Source: protocol paper-wildghand; the oracle in
    the tests is scikit-image's `structural_similarity` with its defaults and a data range of 2.
    """
    box = bounding_box(mask).at_least(settings.size)
    x, y = (crop(composite(image, mask), box) for image in (prediction, target))
    return float(ssim_map(x, y, settings).mean())


def _window_mean(image: np.ndarray, settings: SsimSettings) -> np.ndarray:
    """Weighted mean of the window around every pixel; the border is cut off by the caller."""
    if settings.window == "gaussian":
        kernel = cv2.getGaussianKernel(settings.size, settings.sigma)
        return cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel)
    return cv2.boxFilter(image, cv2.CV_64F, (settings.size, settings.size))


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
        prediction: (H, W, 3) float in [0, 1], sRGB, like `target`.
        mask: (H, W) bool, the scored pixels.
        padding: pixels that the mask's box is grown by.

    Returns:
        0 for identical images, at most 1 (black against white); symmetric. Filters run in
        float32, means in float64.

    Source: `docs/protocol.md`; the form follows Zhang et al., CVPR 2018, equation 1.
    """
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

    (H, W) float32 gives (H, W, ORIENTATIONS) float32, not negative.
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
