"""Networks that see coloured discs in place of hands: red is a right hand, blue a left one."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from hwp_bench.tracking.networks import HAND_EDGE, PALM_EDGE, SeenHand, anchors

#: Size of the pictures, (width, height), and the discs' radius, px.
SIZE, RADIUS = (160, 120), 9
#: An open hand around a disc's centre, in units of the radius, y down; straight upwards, since a
#: disc does not say how it is turned.
LAYOUT = np.array(
    [(0, 1.2)]
    + [(-1.1 + 0.1 * k, 0.6 - 0.3 * k) for k in range(4)]
    + [(-0.4 + 0.4 * f, -0.4 - 0.25 * k) for f in range(4) for k in range(4)]
)


def picture(discs: dict[str, tuple[float, float]]) -> np.ndarray:
    """A frame with discs at the places (x, y); those that come later cover the ones before."""
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    for side, (x, y) in discs.items():
        colour = (255, 0, 0) if side == "right" else (0, 0, 255)
        cv2.circle(image, (round(x), round(y)), RADIUS, colour, -1)
    return image


class FakeNetworks:
    """Finds the discs.

    Args:
        wrong_every: the side of each n-th answer is wrong; 0 = never.
    """

    def __init__(self, wrong_every: int = 0) -> None:
        self.palm_calls = self.hand_calls = 0
        self._wrong_every = wrong_every

    def palms(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Boxes around the discs; each disc is found at two anchors."""
        assert image.shape == (PALM_EDGE, PALM_EDGE, 3)
        self.palm_calls += 1
        values = np.zeros((2016, 18), np.float32)
        logits = np.full(2016, -20, np.float32)
        for x, y, radius, _ in _discs(image):
            near = np.argsort(np.linalg.norm(anchors() * PALM_EDGE - (x, y), axis=1))[:2]
            for row, logit in zip(near, (3.0, 2.0), strict=True):
                offset = np.array([x, y]) - anchors()[row] * PALM_EDGE
                values[row, :4] = *offset, 1.5 * radius, 1.5 * radius
                values[row, 4:] = np.tile(offset, 7)
                values[row, 5] += 1.2 * radius  # the wrist is below
                values[row, 9] -= 0.4 * radius  # the middle finger above
                logits[row] = logit
        return values, logits

    def hand(self, image: np.ndarray) -> SeenHand:
        """Landmarks around the disc that is next to the middle."""
        assert image.shape == (HAND_EDGE, HAND_EDGE, 3)
        self.hand_calls += 1
        world = np.column_stack([LAYOUT * 0.04, np.zeros(21)])
        points = np.zeros((21, 3))
        found = sorted(_discs(image), key=lambda disc: np.hypot(disc[0] - 112, disc[1] - 112))
        if not found:
            return SeenHand(points, world, 0.01, 0.5)
        x, y, radius, right = found[0]
        points[:, :2] = np.array([x, y]) + LAYOUT * radius
        if self._wrong_every and self.hand_calls % self._wrong_every == 0:
            right = not right
        return SeenHand(points, world, 0.99, 0.95 if right else 0.05)


def _discs(image: np.ndarray) -> Iterator[tuple[float, float, float, bool]]:
    """Centre, radius and colour of each disc of which enough is seen."""
    for channel, right in ((0, True), (2, False)):
        rows, columns = np.nonzero(image[:, :, channel] > 127)
        if len(rows) > 30:
            # The extent, and not the area, so that a disc that is covered in part keeps its size.
            radius = max(np.ptp(rows), np.ptp(columns)) / 2
            yield float(columns.mean()), float(rows.mean()), float(radius), right
