"""What MediaPipe's networks see: rotated regions of an image, palms in it, and hands in regions.

Source: the graphs `palm_detection_cpu`, `palm_detection_detection_to_roi`, `hand_landmark_cpu` and
`hand_landmark_landmarks_to_roi` of MediaPipe 0.10.21.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Region:
    """A rectangle in an image, turned about its centre."""

    #: Centre, px from the left edge of the image.
    x: float
    #: Centre, px from its upper edge.
    y: float
    #: Px, along the rectangle's own first axis.
    width: float
    #: Px, along its second axis.
    height: float
    #: Rad, clockwise as the image is seen; 0 = upright.
    rotation: float = 0.0

    def matrix(self) -> np.ndarray:
        """Return (2, 3) float64: from the unit square (0, 0)-(1, 1) to pixels of the image."""
        cos, sin = math.cos(self.rotation), math.sin(self.rotation)
        linear = np.array(
            [[cos * self.width, -sin * self.height], [sin * self.width, cos * self.height]]
        )
        return np.column_stack([linear, np.array([self.x, self.y]) - linear.sum(axis=1) / 2])

    def grow(self, scale: float, shift: float) -> Region:
        """Return the square around this rectangle, moved and then scaled.

        Its edge is `scale` times the longer side; it is moved along the second axis by `shift`
        times the height. Source: MediaPipe's RectTransformationCalculator with `square_long`.
        """
        step = shift * self.height
        edge = scale * max(self.width, self.height)
        return Region(
            self.x - step * math.sin(self.rotation),
            self.y + step * math.cos(self.rotation),
            edge,
            edge,
            self.rotation,
        )


def full_square(width: int, height: int) -> Region:
    """Return the upright square around an image of this size, centred; bands are outside of it."""
    edge = float(max(width, height))
    return Region(width / 2, height / 2, edge, edge)


def angle_of(start: np.ndarray, end: np.ndarray) -> float:
    """The rotation of a region whose upward direction is from `start` to `end`, (2,) px.

    rad in [-pi, pi), clockwise; 0 where `end` is straight above `start`.
    """
    dx, dy = float(end[0] - start[0]), float(end[1] - start[1])
    angle = math.pi / 2 - math.atan2(-dy, dx)
    return angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))


def overlap(one: Region, other: Region) -> float:
    """Return the intersection over union of two regions, as if both were upright.

    Source: MediaPipe's AssociationNormRectCalculator leaves the rotation out too.
    """
    across = _shared(one.x, one.width, other.x, other.width)
    down = _shared(one.y, one.height, other.y, other.height)
    shared = across * down
    union = one.width * one.height + other.width * other.height - shared
    return shared / union if union > 0 else 0.0


def _shared(centre: float, length: float, other: float, other_length: float) -> float:
    """Length that two intervals share."""
    end = min(centre + length / 2, other + other_length / 2)
    return max(end - max(centre - length / 2, other - other_length / 2), 0.0)


def cut_region(image: np.ndarray, region: Region, edge: int, *, outside_black: bool) -> np.ndarray:
    """Resample a region, which may reach beyond its image, into a square: (edge, edge, 3) uint8.

    What lies outside the image is black, or the image's edge goes on. Position (0, 0) is the
    region's first corner, as in MediaPipe's ImageToTensorCalculator, which samples bilinearly and
    does not smooth.
    """
    import cv2

    matrix = region.matrix()
    matrix[:, :2] /= edge
    border = cv2.BORDER_CONSTANT if outside_black else cv2.BORDER_REPLICATE
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, matrix, (edge, edge), flags=flags, borderMode=border)


def to_image(points: np.ndarray, region: Region) -> np.ndarray:
    """Map (..., 2) points of a region's unit square to pixels of the image."""
    matrix = region.matrix()
    return points @ matrix[:, :2].T + matrix[:, 2]


# --- Palms

#: Edge of the images that the detector takes, px.
PALM_EDGE = 192
#: Rows of anchors and columns of them, and anchors at each place: strides 8, and 16 three times.
_GRIDS = ((24, 2), (12, 6))
#: Number of anchors.
ANCHOR_COUNT = sum(cells * cells * each for cells, each in _GRIDS)
#: A box (centre, size) and seven keypoints.
PALM_VALUES = 18
#: Keypoints that say how the hand is turned: the wrist, and the base of the middle finger.
_PALM_WRIST, _PALM_MIDDLE = 0, 2
#: Boxes with more overlap than this are one palm.
_SAME_PALM = 0.3
#: From the palm's box to the hand's region: scale, and shift towards the fingers.
_PALM_GROWTH, _PALM_SHIFT = 2.6, -0.5


@dataclass(frozen=True, eq=False)
class Palm:
    """A palm that was found."""

    #: (2,) upper left corner of its box, px of the image.
    low: np.ndarray
    #: (2,) lower right corner.
    high: np.ndarray
    #: (7, 2) px; the wrist is the first, the base of the middle finger the third.
    keypoints: np.ndarray
    #: In [0, 1].
    score: float

    def hand_region(self) -> Region:
        """Return the square that shows the whole hand, with its fingers upwards."""
        centre, size = (self.low + self.high) / 2, self.high - self.low
        angle = angle_of(self.keypoints[_PALM_WRIST], self.keypoints[_PALM_MIDDLE])
        box = Region(float(centre[0]), float(centre[1]), float(size[0]), float(size[1]), angle)
        return box.grow(_PALM_GROWTH, _PALM_SHIFT)


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
    """Decode the detector's output to palms in the unit square of its image, by anchor.

    `values` (2016, 18) are centre, size and seven keypoints, px of the detector's image, centre and
    keypoints relative to the anchor; `logits` (2016,) those of the scores.
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
    """Replace boxes of the same palm by their mean, weighted with their scores; best first.

    Each has the score of its best box. Source: MediaPipe's NonMaxSuppressionCalculator, algorithm
    WEIGHTED.
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


# --- Hands

#: Edge of the images that the network takes, px.
HAND_EDGE = 224
#: Landmarks that hardly move against each other; the next region is the box around them.
_STABLE = np.array([0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18])
_WRIST, _INDEX, _MIDDLE, _RING = 0, 5, 9, 13
#: From the box of the stable landmarks to the next region: scale, and shift to the fingers.
_GROWTH, _SHIFT = 2.0, -0.1
#: The network's depth is in another scale than its image.
_DEPTH = 0.4


@dataclass(frozen=True, eq=False)
class SeenHand:
    """One hand in one image."""

    #: (21, 3) float64, x, y in px of the image; z in the same unit, negative towards the camera,
    #: relative to the wrist.
    image: np.ndarray
    #: (21, 3) float64 m, x right, y down, z away from the camera; the origin is near the hand's
    #: centre.
    world: np.ndarray
    #: Probability that it is a hand.
    presence: float
    #: Probability that it is a right hand, if the video is not mirrored.
    right: float

    def next_region(self) -> Region:
        """Return the region in which this hand is looked for in the next image."""
        points = self.image[:, :2]
        fingers = ((points[_INDEX] + points[_RING]) / 2 + points[_MIDDLE]) / 2
        angle = angle_of(points[_WRIST], fingers)
        cos, sin = math.cos(angle), math.sin(angle)
        axes = np.array([[cos, -sin], [sin, cos]])  # columns: the region's axes
        turned = points[_STABLE] @ axes
        low, high = turned.min(axis=0), turned.max(axis=0)
        x, y = axes @ ((low + high) / 2)
        width, height = high - low
        box = Region(float(x), float(y), float(width), float(height), angle)
        return box.grow(_GROWTH, _SHIFT)

    def size(self) -> float:
        """Return the longer side of the box around all landmarks, px."""
        return float(np.ptp(self.image[:, :2], axis=0).max())

    def place_in(self, region: Region) -> SeenHand:
        """Put what the network says of a region, a square, into the image.

        The network's points are px of its own image, and its axes those of the region.
        """
        points = self.image.astype(np.float64) / HAND_EDGE
        flat = to_image(points[:, :2], region)
        depth = points[:, 2:] / _DEPTH * region.width
        cos, sin = math.cos(region.rotation), math.sin(region.rotation)
        world = self.world.astype(np.float64)
        turned = world[:, :2] @ np.array([[cos, -sin], [sin, cos]]).T
        return SeenHand(
            np.concatenate([flat, depth], axis=1),
            np.concatenate([turned, world[:, 2:]], axis=1),
            self.presence,
            self.right,
        )
