"""The surface of posed hands, and how their pixels move when the pose changes."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from hwp_bench.hands.articulation import axis_angle_to_matrix, matrix_to_axis_angle
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.hands.skeleton import JOINT_COUNT, Camera, HandPose
from hwp_bench.hands.skinning import pose_hand, project
from hwp_bench.hands.template import HandTemplate, TemplateTensors

# Numbers of each hand: the turn of every joint, then the translation.
_TURNS = 3 * JOINT_COUNT
_COUNT = _TURNS + 3
# Scale of an error in each of them, rad and m: estimators err by about 6 degrees and 1 cm.
_TURN, _SHIFT = 0.1, 0.01
# Step of the differences that give slopes, as a share of the scale: 1e-4 rad.
_STEP = 1e-3


class MovingSurface:
    """The hands of one frame as they are estimated, and where other poses would put their pixels.

    A change has K numbers, 51 for each hand in the order of `hands`: a rotation vector for each
    of the 16 joints, rad, which turns the joint after its estimated rotation (in the axes of its
    parent), and the translation, m.

    Args:
        templates: by side.
        hands: the estimated hands of the frame, by side, at least one.
        camera: the camera; the images have its size.
    """

    def __init__(
        self, templates: Mapping[str, HandTemplate], hands: Mapping[str, HandPose], camera: Camera
    ) -> None:
        self._camera, self._hands = camera, tuple(hands.values())
        self._tensors = [templates[side].to_torch(torch.float64) for side in hands]
        starts = np.cumsum([0, *(len(templates[side].vertices) for side in hands)])
        self._parts = [slice(*ends) for ends in pairwise(starts.tolist())]
        self._faces = np.concatenate(
            [
                templates[side].faces + part.start
                for side, part in zip(hands, self._parts, strict=True)
            ]
        ).astype(np.int64)
        #: (K,) scale of an error in each number: 0.1 rad, 0.01 m.
        self.scales = np.tile(np.repeat([_TURN, _SHIFT], [_TURNS, 3]), len(hands))
        self._places, _ = self._project(np.zeros(len(self.scales)))
        self._drawn_for: np.ndarray | None = None

    def sources(self, change: np.ndarray) -> np.ndarray:
        """Where the pixels of the changed hands lie in the image of the estimated ones.

        The changed surface is drawn, so that a finger that moves covers what is behind it. Pixels
        off the changed hands move as the nearest pixel on them: borders move with the hand.

        Args:
            change: (K,).

        Returns:
            (H, W, 2) float32 column and row of the source, px; 0 is the centre of the first
            pixel, as OpenCV's `remap` takes it. Every pixel itself if no hand is in the image.
        """
        self._draw(change)
        height, width = self._camera.height, self._camera.width
        columns, rows = np.meshgrid(np.arange(width), np.arange(height))
        here = np.stack([columns, rows], axis=-1).astype(np.float64)
        if self._inside is None:
            return here.astype(np.float32)
        shown, mixed = self._inside
        from_place = mix_corners(self._places, self._faces, shown, mixed) - 0.5
        ways = from_place - here.reshape(-1, 2)[self._pixels]
        return (here + ways[self._nearest]).astype(np.float32)

    def moves(self, change: np.ndarray, region: np.ndarray) -> np.ndarray:
        """How far the surface at some pixels goes by a unit of each number, near a change.

        Args:
            change: (K,).
            region: (H, W) bool, P pixels.

        Returns:
            (P, 2, K) px to the right and down by rad and m; zeros if no hand is in the image.
        """
        self._draw(change)
        count = len(self.scales)
        if self._inside is None:
            return np.zeros((np.count_nonzero(region), 2, count))
        by_vertex = self._slopes(change).reshape(-1, 2 * count)
        wanted, back = np.unique(self._nearest[region], return_inverse=True)
        shown, mixed = (values[wanted] for values in self._inside)
        found = mix_corners(by_vertex, self._faces, shown, mixed)
        return found[back].reshape(-1, 2, count).astype(np.float64)

    def _draw(self, change: np.ndarray) -> None:
        if self._drawn_for is not None and np.array_equal(self._drawn_for, change):
            return
        places, depth = self._project(change)
        size = (self._camera.height, self._camera.width)
        face, mix = draw_faces(places, depth, self._faces, size)
        self._pixels = np.flatnonzero(face >= 0)
        self._inside = None
        if len(self._pixels):
            self._inside = face.reshape(-1)[self._pixels], mix.reshape(-1, 2)[self._pixels]
            rows, columns = distance_transform_edt(
                face < 0, return_distances=False, return_indices=True
            )
            # Number, among the pixels on the hands, of the one nearest to each pixel.
            self._nearest = np.searchsorted(self._pixels, rows * size[1] + columns)
        self._drawn_for = change.copy()

    def _project(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (V, 2) px and depths (V,) m of all vertices under a change (K,)."""
        found = [
            self._project_hand(hand, part[None])
            for hand, part in enumerate(np.split(change, len(self._hands)))
        ]
        places, depths = zip(*found, strict=True)
        return np.concatenate(places, axis=1)[0], np.concatenate(depths, axis=1)[0]

    def _slopes(self, change: np.ndarray) -> np.ndarray:
        """Derivative (V, 2, K) of the places of all vertices; a hand moves its own alone."""
        slopes = np.zeros((len(self._places), 2, len(change)))
        for hand, part in enumerate(self._parts):
            own = slice(_COUNT * hand, _COUNT * (hand + 1))
            steps = np.diag(_STEP * self.scales[own])
            ahead, _ = self._project_hand(hand, change[own] + np.vstack([steps, 0.0 * steps[:1]]))
            moved = (ahead[:-1] - ahead[-1]) / (_STEP * self.scales[own, None, None])
            slopes[part, :, own] = moved.transpose(1, 2, 0)
        return slopes

    def _project_hand(self, hand: int, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (B, V, 2) and depths (B, V) of one hand's vertices under B changes (B, 51)."""
        vertices = _posed(self._tensors[hand], self._hands[hand], changes)
        count = len(changes)
        viewmats = torch.as_tensor(self._camera.viewmat).double().expand(count, -1, -1)
        Ks = torch.as_tensor(self._camera.K).double().expand(count, -1, -1)
        places, depth = project(vertices, viewmats, Ks)
        return places.numpy(), depth.numpy()


def _posed(tensors: TemplateTensors, hand: HandPose, changes: np.ndarray) -> torch.Tensor:
    """Vertices (B, V, 3) of a hand under B changes (B, 51)."""
    given = torch.as_tensor(changes)
    turns = axis_angle_to_matrix(given[:, :_TURNS].reshape(-1, JOINT_COUNT, 3))
    pose = matrix_to_axis_angle(turns @ axis_angle_to_matrix(torch.as_tensor(hand.pose)))
    transl = torch.as_tensor(hand.transl) + given[:, _TURNS:]
    return pose_hand(tensors, pose, torch.as_tensor(hand.betas), transl).vertices
