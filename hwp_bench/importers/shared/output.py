"""The output of an import: the capture, a sheet to look at, and the import's own report."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import progress
from hwp_bench.base.drawing import labelled, outlined, sheet
from hwp_bench.base.files import refuse_existing as refuse_folder
from hwp_bench.capture import Cameras, CaptureInfo, CaptureWriter
from hwp_bench.hands import HandParameters, HandTemplate, PosedHand, pose_hand, project
from hwp_bench.importers.shared.frames import each_frame
from hwp_bench.importers.shared.landmarks import LANDMARK_EDGES

#: Name of the overlay sheet among the capture's extra files.
SHEET_NAME = "overlay.png"
#: Name of the report among the capture's extra files.
REPORT_NAME = "import.json"
# Colour of the mesh where it faces the camera; it darkens towards its outline.
_MESH = (120, 150, 255)
# Bones of the fitted model, and landmarks of the tracker.
_FITTED, _TRACKED = (255, 160, 0), (255, 255, 255)
# Bits of fractions of a pixel in what OpenCV draws.
_SHIFT = 4


def refuse_existing(out: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Refuse an output folder that is not empty before minutes of work, not after them."""
    refuse_folder(out, overwrite=overwrite, flag="--force")


def write_capture(
    out: str | os.PathLike[str],
    info: CaptureInfo,
    hands: Mapping[str, HandParameters],
    cameras: Cameras,
    frames: Iterable[tuple[np.ndarray, np.ndarray]],
    sheet: Callable[[], np.ndarray],
    facts: Mapping[str, Any],
    *,
    overwrite: bool,
) -> None:
    """Write a capture, whole or not at all.

    Args:
        frames: for each frame its image (H, W, 3) uint8 sRGB and its mask (H, W) uint8.
        sheet: draws the overlay sheet, (H, W, 3) uint8; called once all frames are written.
    """
    with (
        CaptureWriter(out, info, hands, cameras, overwrite=overwrite) as writer,
        progress("writing the capture", info.frame_count) as update,
    ):

        def store(numbered: tuple[int, tuple[np.ndarray, np.ndarray]]) -> int:
            frame, (image, mask) = numbered
            writer.frame(frame, image)
            writer.mask(frame, mask)
            return frame

        for frame in each_frame(store, enumerate(frames)):
            update(frame + 1)
        writer.extra(SHEET_NAME, cv2.imencode(".png", sheet()[:, :, ::-1])[1].tobytes())
        writer.extra(REPORT_NAME, json.dumps(dict(facts), indent=1) + "\n")


# --- The overlay sheet


@dataclass(frozen=True, eq=False)
class ProjectedHand:
    """One hand in every frame, as its cameras see it."""

    #: (F, V, 3) m, camera axes.
    vertices: np.ndarray
    #: (F, V, 2) px, pixel centres at +0.5.
    pixels: np.ndarray
    #: (F, 21, 2) px, OpenPose order.
    landmarks: np.ndarray
    #: (T, 3) int, counter-clockwise seen from outside.
    faces: np.ndarray
    #: (F,) bool, false where the frame does not show this hand.
    valid: np.ndarray


def pose_parameters(template: HandTemplate, hand: HandParameters) -> PosedHand:
    """Pose a hand in every frame, in float64."""
    with torch.no_grad():
        return pose_hand(
            template.to_torch(torch.float64),
            torch.from_numpy(hand.pose),
            torch.from_numpy(hand.betas),
            torch.from_numpy(hand.transl),
        )


def project_hand(template: HandTemplate, hand: HandParameters, cameras: Cameras) -> ProjectedHand:
    """Pose a hand in every frame and project it."""
    viewmats, Ks = torch.from_numpy(cameras.viewmats), torch.from_numpy(cameras.Ks)
    posed = pose_parameters(template, hand)
    with torch.no_grad():
        pixels, _ = project(posed.vertices, viewmats, Ks)
        landmarks, _ = project(posed.landmarks, viewmats, Ks)
        vertices = posed.vertices @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    return ProjectedHand(
        vertices.numpy(), pixels.numpy(), landmarks.numpy(), template.faces, hand.valid
    )


def sheet_frames(count: int, most: int = 12) -> list[int]:
    """Return evenly spaced frames for a sheet, at most `most` of `count`."""
    return evenly(count, most).tolist()


def overlay_sheet(
    hands: Sequence[ProjectedHand],
    images: Mapping[int, np.ndarray],
    masks: Mapping[int, np.ndarray],
    tracked: Mapping[int, np.ndarray] | None = None,
    captions: Mapping[int, str] | None = None,
) -> np.ndarray:
    """Draw frames with the outline of their masks, with the posed meshes next to them.

    Args:
        images: (S, S, 3) uint8 by frame.
        masks: (S, S) uint8 by frame.
        tracked: (N, 2) px by frame, points that are drawn as dots, NaN where unknown.

    Returns:
        (H, W, 3) uint8.
    """
    faces, offset = [], 0
    for hand in hands:
        faces.append(hand.faces + offset)
        offset += hand.vertices.shape[1]
    tiles = []
    for frame, image in images.items():
        # Triangles of no size are not drawn, so a hand that is not visible does not appear.
        vertices = np.concatenate([hand.vertices[frame] * hand.valid[frame] for hand in hands])
        pixels = np.concatenate([hand.pixels[frame] for hand in hands])
        drawn = _draw_mesh(image, vertices, pixels, np.concatenate(faces))
        for hand in hands:
            if hand.valid[frame]:
                _draw_bones(drawn, hand.landmarks[frame])
        if tracked is not None:
            dots = tracked[frame]
            for x, y in _fractions(dots[np.isfinite(dots).all(axis=1)]):
                cv2.circle(drawn, (x, y), 3 << _SHIFT - 1, _TRACKED, -1, cv2.LINE_AA, _SHIFT)
        pair = np.concatenate([outlined(image, masks[frame]), drawn], axis=1)
        tiles.append(labelled(pair, f"frame {frame}" if captions is None else captions[frame]))
    return sheet(tiles, columns=4)


def _draw_mesh(
    image: np.ndarray, vertices: np.ndarray, pixels: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Blend a mesh, vertices (V, 3) m at (V, 2) px, over an image, far triangles first."""
    triangles = vertices[faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    middles = triangles.mean(axis=1)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(middles, axis=1)
    facing = -(normals * middles).sum(axis=1) / np.maximum(lengths, 1e-20)
    corners = np.array(_fractions(pixels), dtype=np.int32)
    layer = image.copy()
    for face in np.argsort(-middles[:, 2]):
        if facing[face] > 0:
            shade = tuple((0.35 + 0.65 * facing[face]) * np.array(_MESH))
            cv2.fillConvexPoly(layer, corners[faces[face]], shade, cv2.LINE_8, _SHIFT)
    return cv2.addWeighted(layer, 0.6, image, 0.4, 0)


def _draw_bones(canvas: np.ndarray, landmarks: np.ndarray) -> None:
    spots = _fractions(landmarks)
    for first, last in LANDMARK_EDGES:
        cv2.line(canvas, spots[first], spots[last], _FITTED, 1, cv2.LINE_AA, _SHIFT)


def _fractions(pixels: np.ndarray) -> list[tuple[int, int]]:
    """Places as OpenCV draws them, in fractions of a pixel with integers at its centre."""
    scaled = np.clip((pixels - 0.5) * 2**_SHIFT, -(2**20), 2**20).round().astype(int)
    return [(x, y) for x, y in scaled.tolist()]
