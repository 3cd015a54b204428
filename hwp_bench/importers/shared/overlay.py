"""Hands projected into the frames of a clip, and the overlay sheet of an import."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import labelled, outlined, sheet
from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, HandTemplate, pose_hand, project
from hwp_bench.importers.shared.landmarks import LANDMARK_EDGES

#: Frames on a sheet.
SHEET_FRAMES = 12
#: Colour of the mesh where it faces the camera; it darkens towards its outline.
MESH = (120, 150, 255)
#: Bones of the fitted model.
FITTED = (255, 160, 0)
#: Landmarks of the tracker.
TRACKED = (255, 255, 255)
_SHIFT = 4
_LANDMARKS = 21


@dataclass(frozen=True, eq=False)
class ProjectedHand:
    """One hand in every frame, as its cameras see it.

    Attributes:
        vertices: (F, V, 3) m, camera axes.
        pixels: (F, V, 2) px, pixel centres at +0.5.
        landmarks: (F, 21, 2) px, OpenPose order.
        faces: (T, 3) int.
        valid: (F,) bool, false where the frame does not show this hand.
    """

    vertices: np.ndarray
    pixels: np.ndarray
    landmarks: np.ndarray
    faces: np.ndarray
    valid: np.ndarray


def project_hand(template: HandTemplate, hand: HandParameters, cameras: Cameras) -> ProjectedHand:
    """Pose a hand in every frame and project it."""
    viewmats, Ks = torch.from_numpy(cameras.viewmats), torch.from_numpy(cameras.Ks)
    with torch.no_grad():
        posed = pose_hand(
            template.to_torch(torch.float64),
            torch.from_numpy(hand.pose),
            torch.from_numpy(hand.betas),
            torch.from_numpy(hand.transl),
        )
        pixels, _ = project(posed.vertices, viewmats, Ks)
        landmarks, _ = project(posed.landmarks, viewmats, Ks)
        vertices = posed.vertices @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    return ProjectedHand(
        vertices.numpy(), pixels.numpy(), landmarks.numpy(), template.faces, hand.valid
    )


def sheet_frames(count: int, most: int = SHEET_FRAMES) -> list[int]:
    """Return evenly spaced frames for a sheet, at most `most` of `count`."""
    return evenly(count, most).tolist()


def posed_sheet(
    clips: Mapping[str, ProjectedHand],
    images: Mapping[int, np.ndarray],
    masks: Mapping[int, np.ndarray],
    tracked: np.ndarray | None = None,
) -> np.ndarray:
    """Draw frames with the outline of their masks, with the posed meshes next to them.

    Args:
        clips: the hands by side, at least one; the skeleton of the first is drawn.
        images: (H, W, 3) uint8 by frame.
        masks: (H, W) uint8 by frame.
        tracked: (F, N, 2) px, points of the data set to be drawn as dots, NaN where unknown.

    Returns:
        (H, W, 3) uint8.
    """
    first = next(iter(clips.values()))
    faces, offset = [], 0
    for clip in clips.values():
        faces.append(clip.faces + offset)
        offset += clip.vertices.shape[1]
    tiles = []
    for frame, image in images.items():
        dots = None if tracked is None else tracked[frame]
        tiles.append(
            OverlayFrame(
                caption=f"frame {frame}",
                image=image,
                mask=masks[frame],
                # Triangles of no size are not drawn, so a hand that is not visible does not appear.
                vertices=np.concatenate(
                    [clip.vertices[frame] * clip.valid[frame] for clip in clips.values()]
                ),
                pixels=np.concatenate([clip.pixels[frame] for clip in clips.values()]),
                fitted=np.where(first.valid[frame], first.landmarks[frame], -9.0),
                tracked=None if dots is None else dots[np.isfinite(dots).all(axis=1)],
            )
        )
    return overlay_sheet(tiles, np.concatenate(faces))


@dataclass(frozen=True, eq=False)
class OverlayFrame:
    """One frame on the sheet.

    Attributes:
        caption: line over the tile.
        image: (S, S, 3) uint8 RGB.
        mask: (S, S) uint8, visible hand.
        vertices: (V, 3) m, camera axes.
        pixels: (V, 2) px of this image.
        fitted: (21, 2) px, landmarks of the model; 21 for each hand.
        tracked: (N, 2) px, landmarks of the tracker, or None where it saw nothing.
    """

    caption: str
    image: np.ndarray
    mask: np.ndarray
    vertices: np.ndarray
    pixels: np.ndarray
    fitted: np.ndarray
    tracked: np.ndarray | None


def overlay_sheet(frames: Sequence[OverlayFrame], faces: np.ndarray) -> np.ndarray:
    """Draw the sheet: for each frame its mask's outline, and next to it the shaded mesh.

    Args:
        frames: at least one.
        faces: (F, 3) int.

    Returns:
        (H, W, 3) uint8.
    """
    tiles = []
    for frame in frames:
        mesh = draw_mesh(frame.image, frame.vertices, frame.pixels, faces)
        joints = _draw_landmarks(mesh, frame.fitted, frame.tracked)
        pair = np.concatenate([outlined(frame.image, frame.mask), joints], axis=1)
        tiles.append(labelled(pair, frame.caption))
    return sheet(tiles, columns=4)


def draw_mesh(
    image: np.ndarray, vertices: np.ndarray, pixels: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Blend a mesh over an image, far triangles first.

    Args:
        image: (S, S, 3) uint8.
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
    layer = image.copy()
    for face in np.argsort(-middles[:, 2]):
        if facing[face] > 0:
            shade = tuple((0.35 + 0.65 * facing[face]) * np.array(MESH))
            cv2.fillConvexPoly(layer, corners[faces[face]], shade, cv2.LINE_8, _SHIFT)
    return cv2.addWeighted(layer, 0.6, image, 0.4, 0)


def _draw_landmarks(
    image: np.ndarray, fitted: np.ndarray, tracked: np.ndarray | None
) -> np.ndarray:
    import cv2

    canvas = image.copy()
    scale = 2**_SHIFT
    spots = np.clip((fitted - 0.5) * scale, -(2**20), 2**20).round().astype(int).tolist()
    for hand in range(0, len(spots), _LANDMARKS):
        for first, last in LANDMARK_EDGES:
            ends = spots[hand + first], spots[hand + last]
            cv2.line(canvas, *ends, FITTED, 1, cv2.LINE_AA, _SHIFT)
    if tracked is not None:
        for x, y in np.clip((tracked - 0.5) * scale, -(2**20), 2**20).round().astype(int).tolist():
            cv2.circle(canvas, (x, y), int(1.5 * scale), TRACKED, -1, cv2.LINE_AA, _SHIFT)
    return canvas
