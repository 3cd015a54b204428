"""How large a prediction draws the hand, which the headline protocol does not see.

The data set owns the mask, so that no method chooses its own pixels. The price is that colour
outside of the mask costs nothing, while a hand that is a little too small costs much. So a hand
that is drawn too large scores better than one that is right in the mean. These numbers show how
large a method draws, and what it would still gain by drawing larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hwp_bench.metrics.pixels import (
    check_prediction,
    check_truth,
    composite,
    decibels,
    hand_pixels,
    scored_pixels,
    squared_error,
)
from hwp_bench.metrics.protocol import HWP_V1

#: A pixel of a prediction shows something if a channel is above this; methods draw over black.
LIT = 12
#: Where a mask does not know each pixel's coverage, its outline is uncertain by this much, px.
UNCERTAIN = 2
# A pixel with those around it. The outermost pixels of a drawing mix its colours with black.
_RIM = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class OutlineScores:
    """One frame, by what its prediction draws outside of the hand."""

    #: PSNR of the headline protocol, dB.
    psnr: float
    #: Lit pixels that the hand does not touch, as a share of the scored pixels.
    drawn_outside: float
    #: The same error and that of all pixels that the hand does not touch, which should be black,
    #: over the number of scored pixels, dB.
    psnr_with_outside: float
    #: The headline's PSNR if every pixel outside of the drawn hand took the nearest colour of it,
    #: dB.
    psnr_spread: float


def outline_scores(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray, *, coverage: bool = False
) -> OutlineScores | None:
    """Score a frame with and without what lies outside of the hand.

    Args:
        prediction: (H, W, 3) uint8 sRGB over black.
        target: (H, W, 3) uint8.
        mask: (H, W) uint8 or bool, the data set's own visible-hand mask.
        coverage: True where `mask` holds the share of each pixel that the hand covers.

    Returns:
        The scores; None where no pixel is scored.

    Raises:
        BadImage, BadPrediction, ShapeMismatch: as `score_frame`.
    """
    check_truth(target, mask)
    check_prediction(prediction, target)
    region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=coverage)
    count = int(np.count_nonzero(region))
    if not count:
        return None
    outside = _untouched(mask, coverage=coverage)
    lit = prediction.max(axis=2) > LIT
    black = composite(target, ~outside)
    error = squared_error(prediction, black)
    spread = squared_error(spread_outwards(prediction, lit), black)

    def score(errors: np.ndarray, pixels: np.ndarray) -> float:
        return decibels(float(errors[pixels].sum()) / (count * 255.0**2))

    return OutlineScores(
        psnr=score(error, region),
        drawn_outside=float(np.count_nonzero(lit & outside)) / count,
        psnr_with_outside=score(error, region | outside),
        psnr_spread=score(spread, region),
    )


def spread_outwards(prediction: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Give every pixel outside of a drawn hand, and its rim, the nearest colour within.

    Args:
        prediction: (H, W, 3) uint8.
        lit: (H, W) bool, where something is drawn.

    Returns:
        Like the prediction; the prediction itself where nothing is drawn but a rim.
    """
    from scipy.ndimage import distance_transform_edt

    within = cv2.erode(lit.astype(np.uint8), _RIM, borderValue=1) > 0
    if not within.any():
        return prediction
    rows, columns = distance_transform_edt(~within, return_distances=False, return_indices=True)
    return np.asarray(prediction[rows, columns])


def _untouched(mask: np.ndarray, *, coverage: bool) -> np.ndarray:
    """(H, W) bool: pixels of which the hand covers nothing."""
    if coverage and mask.dtype != np.bool_:
        return mask == 0
    near = cv2.dilate(hand_pixels(mask).astype(np.uint8), _RIM, iterations=UNCERTAIN)
    return near == 0
