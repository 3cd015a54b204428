"""The sheet on which a person judges an import: masks, mesh and joints over the frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.drawing import labelled, outlined, sheet
from hwp_bench.importers.landmarks import LANDMARK_EDGES

#: Colour of the mesh where it faces the camera; it darkens towards its outline.
MESH = (120, 150, 255)
#: Bones of the fitted model.
FITTED = (255, 160, 0)
#: Landmarks of the tracker.
TRACKED = (255, 255, 255)
_SHIFT = 4


@dataclass(frozen=True, eq=False)
class OverlayFrame:
    """One frame on the sheet.

    Attributes:
        caption: line over the tile.
        picture: (S, S, 3) uint8 RGB.
        mask: (S, S) uint8, visible hand.
        vertices: (V, 3) m, camera axes.
        pixels: (V, 2) px of this picture.
        fitted: (21, 2) px, landmarks of the model.
        tracked: (21, 2) px, landmarks of the tracker, or None where it saw nothing.
    """

    caption: str
    picture: np.ndarray
    mask: np.ndarray
    vertices: np.ndarray
    pixels: np.ndarray
    fitted: np.ndarray
    tracked: np.ndarray | None


def overlay_sheet(frames: Sequence[OverlayFrame], faces: np.ndarray) -> np.ndarray:
    """Draw the sheet: for each frame its mask's outline, and beside it the shaded mesh.

    Args:
        frames: at least one.
        faces: (F, 3) int.

    Returns:
        (H, W, 3) uint8.
    """
    tiles = []
    for frame in frames:
        mesh = draw_mesh(frame.picture, frame.vertices, frame.pixels, faces)
        joints = _draw_landmarks(mesh, frame.fitted, frame.tracked)
        pair = np.concatenate([outlined(frame.picture, frame.mask), joints], axis=1)
        tiles.append(labelled(pair, frame.caption))
    return sheet(tiles, columns=4)


def draw_mesh(
    picture: np.ndarray, vertices: np.ndarray, pixels: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Blend a mesh over a picture, far triangles first.

    Args:
        picture: (S, S, 3) uint8.
        vertices: (V, 3) m, camera axes.
        pixels: (V, 2) px, centres at +0.5.
        faces: (F, 3) int, counter-clockwise seen from outside.
    """
    import cv2

    triangles = vertices[faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    middles = triangles.mean(axis=1)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(middles, axis=1)
    facing = -(normals * middles).sum(axis=1) / np.maximum(lengths, 1e-20)
    corners = np.clip((pixels - 0.5) * 2**_SHIFT, -(2**20), 2**20).round().astype(np.int32)
    layer = picture.copy()
    for face in np.argsort(-middles[:, 2]):
        if facing[face] > 0:
            shade = tuple((0.35 + 0.65 * facing[face]) * np.array(MESH))
            cv2.fillConvexPoly(layer, corners[faces[face]], shade, cv2.LINE_8, _SHIFT)
    return cv2.addWeighted(layer, 0.6, picture, 0.4, 0)


def _draw_landmarks(
    picture: np.ndarray, fitted: np.ndarray, tracked: np.ndarray | None
) -> np.ndarray:
    import cv2

    canvas = picture.copy()
    scale = 2**_SHIFT
    spots = np.clip((fitted - 0.5) * scale, -(2**20), 2**20).round().astype(int).tolist()
    for first, last in LANDMARK_EDGES:
        cv2.line(canvas, spots[first], spots[last], FITTED, 1, cv2.LINE_AA, _SHIFT)
    if tracked is not None:
        for x, y in np.clip((tracked - 0.5) * scale, -(2**20), 2**20).round().astype(int).tolist():
            cv2.circle(canvas, (x, y), int(1.5 * scale), TRACKED, -1, cv2.LINE_AA, _SHIFT)
    return canvas
