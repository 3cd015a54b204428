"""Palms in an image: anchors of the detector, decoding, suppression, and the hand's region.

Source: the graphs `palm_detection_cpu` and `palm_detection_detection_to_roi` of MediaPipe 0.10.21.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.tracking.regions import Region, angle_of, cut_region, full_square, to_image

#: Edge of the images that the detector takes, px.
PALM_EDGE = 192
#: Rows of anchors and columns of them, and anchors at each place: strides 8, and 16 three times.
_GRIDS = ((24, 2), (12, 6))
#: Number of anchors.
ANCHOR_COUNT = sum(cells * cells * each for cells, each in _GRIDS)
#: A box (centre, size) and seven keypoints.
PALM_VALUES = 18
#: Keypoints that say how the hand is turned: the wrist, and the base of the middle finger.
_WRIST, _MIDDLE = 0, 2
#: Boxes with more overlap than this are one palm.
_SAME_PALM = 0.3
#: From the palm's box to the hand's region: scale, and shift towards the fingers.
_GROWTH, _SHIFT = 2.6, -0.5


@dataclass(frozen=True, eq=False)
class Palm:
    """A palm that was found.

    Attributes:
        low: (2,) upper left corner of its box, px of the image.
        high: (2,) lower right corner.
        keypoints: (7, 2) px; the wrist is the first, the base of the middle finger the third.
        score: in [0, 1].
    """

    low: np.ndarray
    high: np.ndarray
    keypoints: np.ndarray
    score: float

    def hand_region(self) -> Region:
        """Return the square that shows the whole hand, with its fingers upwards."""
        centre, size = (self.low + self.high) / 2, self.high - self.low
        angle = angle_of(self.keypoints[_WRIST], self.keypoints[_MIDDLE])
        box = Region(float(centre[0]), float(centre[1]), float(size[0]), float(size[1]), angle)
        return box.grown(_GROWTH, _SHIFT)


def anchors() -> np.ndarray:
    """Return (2016, 2) float64: centres of the detector's anchors in the unit square, x first.

    Row by row over each grid, with all anchors of a place next to each other. All are of size 1.
    """
    grids = []
    for cells, each in _GRIDS:
        middles = (np.arange(cells) + 0.5) / cells
        y, x = np.meshgrid(middles, middles, indexing="ij")
        grids.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), each, axis=0))
    return np.concatenate(grids)


def decode(values: np.ndarray, logits: np.ndarray, min_score: float) -> list[Palm]:
    """Decode the detector's output.

    Args:
        values: (2016, 18): centre, size and seven keypoints, px of the detector's image, centre
            and keypoints relative to the anchor.
        logits: (2016,) of the scores.
        min_score: palms below it are left out.

    Returns:
        Palms in the unit square of the detector's image, in the order of the anchors.
    """
    scores = 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -100, 100)))
    kept = np.flatnonzero(scores >= min_score)
    points = values[kept].astype(np.float64).reshape(-1, PALM_VALUES // 2, 2) / PALM_EDGE
    size = points[:, 1]
    points = points + anchors()[kept][:, None]
    return [
        Palm(place[0] - half, place[0] + half, place[2:], float(score))
        for place, half, score in zip(points, size / 2, scores[kept], strict=True)
        if (half >= 0).all()
    ]


def suppress(palms: list[Palm]) -> list[Palm]:
    """Replace boxes of the same palm by their mean, weighted with their scores.

    Returns:
        The palms, best first; each has the score of its best box.

    Source: MediaPipe's NonMaxSuppressionCalculator, algorithm WEIGHTED.
    """
    rest = sorted(palms, key=lambda palm: -palm.score)
    found = []
    while rest:
        best = rest[0]
        same = [palm for palm in rest if palm is best or _box_overlap(palm, best) > _SAME_PALM]
        rest = [palm for palm in rest if not any(palm is one for one in same)]
        weights = np.array([palm.score for palm in same])
        weights /= weights.sum()
        found.append(
            Palm(
                np.tensordot(weights, [palm.low for palm in same], 1),
                np.tensordot(weights, [palm.high for palm in same], 1),
                np.tensordot(weights, [palm.keypoints for palm in same], 1),
                best.score,
            )
        )
    return found


def palm_input(image: np.ndarray) -> np.ndarray:
    """Return the detector's image: all of an (H, W, 3) image, with black bands to a square."""
    square = full_square(image.shape[1], image.shape[0])
    return cut_region(image, square, PALM_EDGE, outside_black=True)


def place_in_image(palm: Palm, width: int, height: int) -> Palm:
    """Return a palm of the detector's unit square in pixels of the image."""
    square = full_square(width, height)
    low, high, keypoints = (
        to_image(part, square) for part in (palm.low, palm.high, palm.keypoints)
    )
    return Palm(low, high, keypoints, palm.score)


def _box_overlap(one: Palm, other: Palm) -> float:
    """Intersection over union of two boxes."""
    shared = np.prod(
        np.clip(np.minimum(one.high, other.high) - np.maximum(one.low, other.low), 0, None)
    )
    union = np.prod(one.high - one.low) + np.prod(other.high - other.low) - shared
    return float(shared / union) if union > 0 else 0.0
