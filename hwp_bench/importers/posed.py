"""A clip's hands posed and projected, and the sheet on which a person judges them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, HandTemplate, pose_hand, project
from hwp_bench.importers.overlay import OverlayFrame, overlay_sheet

#: Frames on a sheet.
SHEET_FRAMES = 12


@dataclass(frozen=True, eq=False)
class PosedClip:
    """One hand in every frame, as its cameras see it.

    Attributes:
        vertices: (F, V, 3) m, camera axes.
        pixels: (F, V, 2) px, pixel centres at +0.5.
        landmarks: (F, 21, 2) px, OpenPose order.
        faces: (T, 3) int.
        valid: (F,) bool, false where there is no such hand.
    """

    vertices: np.ndarray
    pixels: np.ndarray
    landmarks: np.ndarray
    faces: np.ndarray
    valid: np.ndarray


def pose_clip(template: HandTemplate, hand: HandParameters, cameras: Cameras) -> PosedClip:
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
    return PosedClip(
        vertices.numpy(), pixels.numpy(), landmarks.numpy(), template.faces, hand.valid
    )


def sheet_frames(count: int) -> list[int]:
    """Evenly spaced frames for a sheet."""
    return (
        np.unique(np.linspace(0, count - 1, min(count, SHEET_FRAMES)).round()).astype(int).tolist()
    )


def posed_sheet(
    clips: Mapping[str, PosedClip],
    pictures: Mapping[int, np.ndarray],
    masks: Mapping[int, np.ndarray],
    tracked: np.ndarray | None = None,
) -> np.ndarray:
    """Draw frames with the outline of their masks, and beside them the posed meshes.

    Args:
        clips: the hands by side, at least one; the skeleton of the first is drawn.
        pictures: (H, W, 3) uint8 by frame.
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
    for frame, picture in pictures.items():
        dots = None if tracked is None else tracked[frame]
        tiles.append(
            OverlayFrame(
                caption=f"frame {frame}",
                picture=picture,
                mask=masks[frame],
                # Triangles of no size are not drawn: a hand that is not there stays away.
                vertices=np.concatenate(
                    [clip.vertices[frame] * clip.valid[frame] for clip in clips.values()]
                ),
                pixels=np.concatenate([clip.pixels[frame] for clip in clips.values()]),
                fitted=np.where(first.valid[frame], first.landmarks[frame], -9.0),
                tracked=None if dots is None else dots[np.isfinite(dots).all(axis=1)],
            )
        )
    return overlay_sheet(tiles, np.concatenate(faces))
