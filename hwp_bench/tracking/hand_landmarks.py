"""Landmarks of one hand in a region of an image, and the region in the next image.

Source: the graphs `hand_landmark_cpu` and `hand_landmark_landmarks_to_roi` of MediaPipe 0.10.21.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hwp_bench.tracking.regions import Region, angle_of, to_image

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
class HandReading:
    """The network's answer about one region.

    Attributes:
        points: (21, 3) px of the network's image: x, y, and depth in a scale of its own.
        world: (21, 3) m, axes of the network's image.
        presence: probability that the region shows a hand.
        right: probability that it is a right hand, if the video is not mirrored.
    """

    points: np.ndarray
    world: np.ndarray
    presence: float
    right: float


@dataclass(frozen=True, eq=False)
class SeenHand:
    """One hand in one image.

    Attributes:
        image: (21, 3) float64, x, y in px of the image; z in the same unit, negative towards the
            camera, relative to the wrist.
        world: (21, 3) float64 m, x right, y down, z away from the camera; the origin is near the
            hand's centre.
        presence: probability that it is a hand.
        right: probability that it is a right hand, if the video is not mirrored.
    """

    image: np.ndarray
    world: np.ndarray
    presence: float
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
        return box.grown(_GROWTH, _SHIFT)

    def size(self) -> float:
        """Return the longer side of the box around all landmarks, px."""
        return float(np.ptp(self.image[:, :2], axis=0).max())


def place_reading(reading: HandReading, region: Region) -> SeenHand:
    """Put the network's answer about a region into the image.

    Args:
        reading: the answer.
        region: that the network saw; a square.
    """
    points = reading.points.astype(np.float64) / HAND_EDGE
    flat = to_image(points[:, :2], region)
    depth = points[:, 2:] / _DEPTH * region.width
    cos, sin = math.cos(region.rotation), math.sin(region.rotation)
    world = reading.world.astype(np.float64)
    turned = world[:, :2] @ np.array([[cos, -sin], [sin, cos]]).T
    return SeenHand(
        np.concatenate([flat, depth], axis=1),
        np.concatenate([turned, world[:, 2:]], axis=1),
        reading.presence,
        reading.right,
    )
