"""A look at the hands of a video while they are fitted: the mesh in the colours of frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.hands.raster import draw_faces
from hwp_bench.importers.shared.frames import cells
from hwp_bench.importers.video.masks import ProjectedClip

# Frames that colours are taken from, and pixels next to a border that are none of the surface.
_FRAMES, _BORDER = 12, np.ones((5, 5), np.uint8)


@dataclass(frozen=True, eq=False)
class PaintedHand:
    """A hand as one frame shows it, in the colours of several."""

    #: (V, 3) m, camera axes.
    vertices: np.ndarray
    #: (T, 3).
    faces: np.ndarray
    #: (V, 3) uint8 sRGB; the mean colour where no frame shows a vertex.
    colors: np.ndarray


#: Takes the hands as they are fitted so far, more than once.
Glimpse = Callable[[Sequence[PaintedHand]], None]


def paint_hand(clip: ProjectedClip, images: np.ndarray, detected: np.ndarray) -> PaintedHand:
    """Colour a fitted hand by images (F, S, S, 3); `detected` (F,) are the frames that count."""
    frames = np.flatnonzero(detected)
    frames = frames[evenly(len(frames), _FRAMES)]
    edge = images.shape[1]
    total, count = np.zeros((clip.vertices.shape[1], 3)), np.zeros((clip.vertices.shape[1], 1))
    for frame in frames:
        pixels = clip.in_crop(frame, edge)
        face, _ = draw_faces(pixels, clip.vertices[frame, :, 2], clip.faces, (edge, edge))
        inside = cv2.erode((face >= 0).astype(np.uint8), _BORDER) > 0
        rows, columns, _ = cells(pixels, face.shape)
        shown = np.unique(clip.faces[face[inside]])
        shown = shown[inside[rows[shown], columns[shown]]]
        total[shown] += images[frame, rows[shown], columns[shown]]
        count[shown] += 1.0
    mean = total.sum(axis=0) / max(float(count.sum()), 1.0)
    colors = np.where(count > 0.0, total / np.maximum(count, 1.0), mean)
    return PaintedHand(clip.vertices[frames[len(frames) // 2]], clip.faces, colors.astype(np.uint8))
