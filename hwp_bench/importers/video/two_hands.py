"""Two hands in one image: which of them a pixel shows, and which landmarks are behind the other.

Skin before skin has no edge that a graph cut finds, so that both hands are cut out together. What
belongs to which hand comes from the fitted meshes: of two that cover a pixel, the nearer one is
seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.hands.raster import draw_faces, draw_silhouette
from hwp_bench.importers.shared.frames_parallel import each_frame
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.video.clip_masks import ProjectedClip
from hwp_bench.importers.video.contour import FIELD_SIZE
from hwp_bench.importers.video.segmentation import Prompt

#: A hand that is not detected is drawn for this many frames before and after it is.
BRIDGED = 5
#: Weight of a landmark that the other hand hides: the tracker has guessed it.
HIDDEN = 0.1
# A landmark lies inside its hand: one that is less than this behind the other's surface is
# touching it, m.
_BEHIND = 0.015
# Edge of the images in which hidden landmarks are looked for, px.
_EDGE = 192


@dataclass(frozen=True, eq=False)
class ProjectedHands:
    """Two projected hands, as one prompt for the cut of their masks.

    Attributes:
        hands: the two.
        shown: (2, F) bool, frames in which each is drawn.
    """

    hands: tuple[ProjectedClip, ProjectedClip]
    shown: np.ndarray

    def prompt(self, frame: int, edge: int, detected: bool) -> Prompt:
        """Draw both meshes; a pixel is on the forearm's side if it is for the nearer hand."""
        prompts = [
            hand.prompt(frame, edge, detected)
            for hand, shown in zip(self.hands, self.shown[:, frame], strict=True)
            if shown
        ]
        if not prompts:
            nothing = np.zeros((edge, edge), dtype=np.uint8)
            return Prompt(nothing, nothing > 0, detected)
        if len(prompts) == 1:
            return prompts[0]
        first, second = prompts
        nearer = _distance(first.silhouette) <= _distance(second.silhouette)
        return Prompt(
            np.maximum(first.silhouette, second.silhouette),
            np.where(nearer, first.beyond, second.beyond),
            detected,
        )

    def coverage(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Divide masks between the hands.

        Args:
            masks: (F, S, S) uint8, visible hands.

        Returns:
            Two arrays like it: the visible part of each hand.
        """

        def first(frame: int) -> np.ndarray:
            return self._owner(frame, masks.shape[1]) == 0

        owned = np.stack(list(each_frame(first, range(len(masks)))))
        return np.where(owned, masks, 0).astype(np.uint8), np.where(owned, 0, masks).astype(
            np.uint8
        )

    def covered(self, hand: int, reach: float) -> np.ndarray:
        """Return (F, FIELD_SIZE, FIELD_SIZE) bool: where the other hand is, or as near as `reach`.

        Args:
            hand: 0 or 1.
            reach: px of the field.
        """
        other = self.hands[1 - hand]

        def near(frame: int) -> np.ndarray:
            if not self.shown[1 - hand, frame]:
                return np.zeros((FIELD_SIZE, FIELD_SIZE), dtype=bool)
            pixels = other.in_crop(other.pixels[frame], frame, FIELD_SIZE)
            drawn = draw_silhouette(pixels, other.faces, FIELD_SIZE)
            return np.asarray(_distance(drawn) <= reach)

        return np.stack(list(each_frame(near, range(self.shown.shape[1]))))

    def trust(self, hand: int) -> np.ndarray:
        """Return (F, 21) weights of landmarks: `HIDDEN` where the other hand hides them."""
        own, other = self.hands[hand], self.hands[1 - hand]

        def weights(frame: int) -> np.ndarray:
            if not self.shown[:, frame].all():
                return np.ones(own.landmarks.shape[1])
            pixels = other.in_crop(other.pixels[frame], frame, _EDGE)
            depth = other.vertices[frame, :, 2]
            face, _ = draw_faces(pixels, depth, other.faces, (_EDGE, _EDGE))
            spots = own.in_crop(own.landmarks[frame], frame, _EDGE)
            column, row = np.clip(np.floor(spots), 0, _EDGE - 1).astype(np.int64).T
            found = face[row, column]
            surface = depth[other.faces[found]].mean(axis=1)
            hidden = (found >= 0) & (own.depths[frame] > surface + _BEHIND)
            return np.where(hidden, HIDDEN, 1.0)

        return np.stack(list(each_frame(weights, range(self.shown.shape[1]))))

    def _owner(self, frame: int, edge: int) -> np.ndarray:
        """(edge, edge) int: the hand that a pixel shows, or that is nearer to it."""
        shown = self.shown[:, frame]
        if not shown.all():
            return np.full((edge, edge), int(shown[1] and not shown[0]))
        first, second = self.hands
        pixels = [hand.in_crop(hand.pixels[frame], frame, edge) for hand in self.hands]
        depth = np.concatenate([hand.vertices[frame, :, 2] for hand in self.hands])
        faces = np.concatenate([first.faces, second.faces + len(pixels[0])])
        face, _ = draw_faces(np.concatenate(pixels), depth, faces, (edge, edge))
        owner = (face >= len(first.faces)).astype(int)
        away = [
            _distance(draw_silhouette(place, hand.faces, edge))
            for place, hand in zip(pixels, self.hands, strict=True)
        ]
        return np.where(face >= 0, owner, (away[1] < away[0]).astype(int))


def project_hands(hands: Sequence[ProjectedClip], landmarks: Sequence[Landmarks]) -> ProjectedHands:
    """Join two projected hands."""
    first, second = hands
    return ProjectedHands((first, second), np.stack([_bridged(one.detected) for one in landmarks]))


def _bridged(detected: np.ndarray) -> np.ndarray:
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(detected, iterations=BRIDGED))


def _distance(silhouette: np.ndarray) -> np.ndarray:
    """Distance of every pixel from a silhouette, px; far for an empty one."""
    import cv2

    if not silhouette.any():
        return np.full(silhouette.shape, np.inf, dtype=np.float32)
    return cv2.distanceTransform(255 - silhouette, cv2.DIST_L2, 3)
