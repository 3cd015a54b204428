"""Rotated rectangles in an image: the networks see the image through them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Region:
    """A rectangle in an image, turned about its centre.

    Attributes:
        x: centre, px from the left edge of the image.
        y: centre, px from its upper edge.
        width: px, along the rectangle's own first axis.
        height: px, along its second axis.
        rotation: rad, clockwise as the image is seen; 0 = upright.
    """

    x: float
    y: float
    width: float
    height: float
    rotation: float = 0.0

    def matrix(self) -> np.ndarray:
        """Return (2, 3) float64: from the unit square (0, 0)-(1, 1) to pixels of the image."""
        cos, sin = math.cos(self.rotation), math.sin(self.rotation)
        linear = np.array(
            [[cos * self.width, -sin * self.height], [sin * self.width, cos * self.height]]
        )
        return np.column_stack([linear, np.array([self.x, self.y]) - linear.sum(axis=1) / 2])

    def grown(self, scale: float, shift: float) -> Region:
        """Return the square around this rectangle, moved and then scaled.

        Args:
            scale: edge of the square, as a multiple of the rectangle's longer side.
            shift: along the second axis, as a share of the rectangle's height.

        Source: MediaPipe's RectTransformationCalculator with `square_long`.
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
    """Return the rotation of a region whose upward direction is that from `start` to `end`.

    Args:
        start: (2,) px.
        end: (2,) px.

    Returns:
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
    """Resample the content of a region into a square image.

    Args:
        image: (H, W, 3) uint8.
        region: of the image; it may reach beyond it.
        edge: px of the result.
        outside_black: what lies outside the image is black; otherwise the image's edge goes on.

    Returns:
        (edge, edge, 3) uint8. Its position (0, 0) is the region's first corner, as in MediaPipe's
        ImageToTensorCalculator, which samples bilinearly and does not smooth.
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
