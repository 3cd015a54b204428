"""Pixels in which something hides the hand: no picture of it, and none of what is behind it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

#: How far inside the posed hand's outline a pixel must lie to count as hidden, as a share of the
#: image's height: closer to it a mask leaves a pixel out because the given pose is not exact.
MARGIN = 0.0085


def hidden_skin(places: Sequence[np.ndarray], masks: np.ndarray) -> np.ndarray:
    """Find the pixels that the masks leave out though the posed hands cover them.

    There a sleeve or an object is in front of the hand. A drawing that is compared with black
    learns black skin, which shows where an avatar is turned around.

    Args:
        places: R times (H, W), 0 where the posed hands are not (`skin_places`).
        masks: (R, H, W) uint8, 255 = visible hand.

    Returns:
        (R, H, W) bool.
    """
    margin = max(1, round(MARGIN * masks.shape[1]))
    square = np.ones((2 * margin + 1, 2 * margin + 1), dtype=np.uint8)
    hidden = np.empty(masks.shape, dtype=bool)
    for row, (place, mask) in enumerate(zip(places, masks, strict=True)):
        inside = cv2.erode((place > 0).astype(np.uint8), square)
        hidden[row] = (inside > 0) & (mask < 128)
    return hidden
