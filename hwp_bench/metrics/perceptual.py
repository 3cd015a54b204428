"""Oriented distance: a perceptual distance that needs no downloaded weights. It is not LPIPS.

Its form is that of LPIPS (channels normalised at every pixel, differences squared, averaged
over space and scales), but the channels are a fixed bank of oriented filters and local means
instead of a trained network: it knows edges, texture, brightness and colour, and nothing of
what a picture shows. `docs/protocol.md` prints how it orders degradations beside SSIM.
"""

from __future__ import annotations

import cv2
import numpy as np

from hwp_bench.metrics.filter_bank import half_size, local_mean, oriented_energies
from hwp_bench.metrics.pixels import check_same_shape
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.region import bounding_box, composite, crop

#: Number of scales; each has half the resolution of the one before.
SCALES = 4
#: Weight of an oriented energy beside the local means in the vector that is normalised: it
#: sets how much texture counts against brightness and colour.
CONTRAST_GAIN = 12.0
#: Brightness of sRGB values (the luma of ITU-R BT.601).
LUMA = np.array([[0.299, 0.587, 0.114]], np.float32)


def oriented_distance(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    padding: int = HWP_V1.box_padding,
) -> float:
    """Distance of two images on the pixels of `mask`, both black outside it.

    On each of four scales every pixel gets a vector of 18 channels, none negative: the local
    mean m of red, green and blue and its complement 1 - m, and for brightness and two opponent
    colours the energy in four directions. Vectors are brought to length 1; half the squared
    difference of the two images' vectors is averaged over the mask (weighted by its share of
    the pixel at that scale), then over the scales.

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
    apart = _squared_length([a - b for a, b in zip(x_vector, y_vector, strict=True)])
    angular = (apart - (x_length - y_length) ** 2) / (x_length * y_length)
    per_pixel = np.maximum(angular, 0.0).astype(np.float64)
    return float(np.sum(per_pixel * weight) / (2.0 * weight.sum(dtype=np.float64)))


def _vector(image: np.ndarray) -> list[np.ndarray]:
    """The channels of every pixel at one scale, as groups (H, W, 3 or 4), none negative.

    The means and their complements alone have a length of at least 1 / sqrt(2).
    """
    share = np.float32(1.0 / np.sqrt(3.0))
    mean = share * local_mean(image)
    return [mean, share - mean, oriented_energies(cv2.transform(image, CONTRAST_GAIN * LUMA))]


def _squared_length(groups: list[np.ndarray]) -> np.ndarray:
    """Sum of squares over all channels of all groups: (H, W) float32."""
    total = np.zeros(groups[0].shape[:2], np.float32)
    for group in groups:
        total += cv2.transform(group * group, np.ones((1, group.shape[2]), np.float32))
    return total
