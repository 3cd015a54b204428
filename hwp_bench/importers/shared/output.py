"""What imports have in common: checks of choices, hands, the capture, its sheet and report."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import progress
from hwp_bench.base.drawing import labelled, outlined, sheet
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import read_json
from hwp_bench.capture import Cameras, CaptureInfo, CaptureWriter, identify_hand_model
from hwp_bench.capture.schema import EXTRA, METADATA
from hwp_bench.hands import HandParameters, HandTemplate, project
from hwp_bench.hands.fitting import FitTargets, FittedHand, fit_hand
from hwp_bench.hands.raster import draw_dots, fixed_point
from hwp_bench.hands.skeleton import draw_bones
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.importers.shared.frames import each_frame

#: The hands that can be asked for; `auto`: those that the data show.
CHOICES = ("auto", "right", "left", "both")
#: Name of the overlay sheet among the capture's extra files.
SHEET_NAME = "overlay.png"
#: Name of the report among the capture's extra files.
REPORT_NAME = "import.json"
# Colour of the mesh where it faces the camera; it darkens towards its outline.
_MESH = (120, 150, 255)
# Bones of the fitted model, and landmarks of the tracker.
_FITTED, _TRACKED = (255, 160, 0), (255, 255, 255)


def check_choices(*rules: tuple[str, bool, str]) -> None:
    """Refuse the first choice that makes no sense: its option, whether it does, what it must be."""
    for option, good, problem in rules:
        if not good:
            raise UsageError(problem, field=option)


@dataclass(frozen=True, kw_only=True)
class ReleaseImport:
    """Choices of an import of a data set; checked when made.

    Raises:
        UsageError: a choice makes no sense.
    """

    #: MANO file or folder, or None to fit the free hand.
    mano: Path | None = None
    #: Edge of the stored square frames, px.
    size: int = 256
    #: Replace an existing capture.
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_choices(("--size", 32 <= self.size <= 2048, "must be 32 to 2048 px"))

    @property
    def model(self) -> str:
        """The hand model, as `load_template` takes it."""
        return "anny" if self.mano is None else f"mano:{Path(self.mano).absolute()}"


def read_report(out: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Read the report of the import that made a capture, whole; None where there is none.

    Its `call` is the digest of what the import was given, where the import keeps it.
    """
    report = Path(out) / EXTRA / REPORT_NAME
    if not report.is_file() or not (Path(out) / METADATA).is_file():
        return None
    try:
        facts = read_json(report)
    except BadInput:
        return None
    return facts if isinstance(facts, dict) else None


def fit_free_hand(
    template: HandTemplate,
    pose: np.ndarray,
    valid: np.ndarray,
    knuckle: np.ndarray,
    targets: FitTargets,
) -> FittedHand:
    """Fit a hand to targets, from a pose (F, 16, 3) with the middle knuckle at (F, 3) m."""
    unplaced = HandParameters(pose, np.zeros(10), np.zeros((len(pose), 3)), valid)
    shift = knuckle - pose_parameters(template, unplaced).landmarks[:, 9].numpy()
    start = replace(unplaced, transl=np.where(valid[:, None], shift, 0.0))
    return fit_hand(template, targets, start)


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


def project_hand(template: HandTemplate, hand: HandParameters, cameras: Cameras) -> ProjectedHand:
    """Pose a hand in every frame and project it."""
    viewmats, Ks = torch.from_numpy(cameras.viewmats), torch.from_numpy(cameras.Ks)
    posed = pose_parameters(template, hand)
    pixels, landmarks = (project(p, viewmats, Ks)[0] for p in (posed.vertices, posed.landmarks))
    vertices = posed.vertices @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    return ProjectedHand(
        vertices.numpy(), pixels.numpy(), landmarks.numpy(), template.faces, hand.valid
    )


def write_capture(
    out: str | os.PathLike[str],
    hands: Mapping[str, HandParameters],
    cameras: Cameras,
    frames: Iterable[tuple[np.ndarray, np.ndarray]],
    clips: Sequence[ProjectedHand],
    facts: Mapping[str, Any],
    *,
    overwrite: bool,
    model: str,
    size: int,
    tracked: np.ndarray | None = None,
    captions: Sequence[str] | None = None,
    most: int = 12,
    **about: Any,
) -> np.ndarray:
    """Write a capture, whole or not at all, and return its overlay sheet, (H, W, 3) uint8.

    Args:
        frames: for each frame its image (S, S, 3) uint8 sRGB and its mask (S, S) uint8.
        clips: the hands, as they are drawn on the sheet.
        facts: the import's report.
        model: the hand model, as `load_template` takes it.
        size: S, px.
        tracked: (F, N, 2) px, points that the sheet shows as dots, NaN where unknown.
        captions: of the frames on the sheet, of which there are at most `most`.
        about: everything else that `CaptureInfo` says.
    """
    count, shown = len(cameras), "both" if len(hands) == 2 else next(iter(hands))
    info = CaptureInfo(
        hands=shown,
        width=size,
        height=size,
        frame_count=count,
        hand_model=identify_hand_model(model, shown),
        **about,
    )
    kept: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    on_sheet = evenly(count, most).tolist()
    with (
        CaptureWriter(out, info, hands, cameras, overwrite=overwrite) as writer,
        progress("writing the capture", count) as update,
    ):

        def store(numbered: tuple[int, tuple[np.ndarray, np.ndarray]]) -> int:
            frame, (image, mask) = numbered
            writer.frame(frame, image)
            writer.mask(frame, mask)
            if frame in on_sheet:
                kept[frame] = image, mask
            return frame

        for frame in each_frame(store, enumerate(frames)):
            update(frame + 1)
        tiles = []
        for frame in on_sheet:
            image, mask = kept[frame]
            drawn = _draw_hands(image, clips, frame, None if tracked is None else tracked[frame])
            caption = f"frame {frame}" if captions is None else captions[frame]
            pair = np.concatenate([outlined(image, mask), drawn], axis=1)
            tiles.append(labelled(pair, caption))
        overview = sheet(tiles, columns=4)
        writer.extra(SHEET_NAME, cv2.imencode(".png", overview[:, :, ::-1])[1].tobytes())
        writer.extra(REPORT_NAME, json.dumps(dict(facts), indent=1) + "\n")
    return overview


def _draw_hands(
    image: np.ndarray, clips: Sequence[ProjectedHand], frame: int, dots: np.ndarray | None
) -> np.ndarray:
    """Draw the meshes, the bones and the dots (N, 2) px of a frame over it."""
    faces, count = [], 0
    for clip in clips:
        faces.append(clip.faces + count)
        count += clip.vertices.shape[1]
    # Triangles of no size are not drawn, so a hand that is not visible does not appear.
    vertices = np.concatenate([clip.vertices[frame] * clip.valid[frame] for clip in clips])
    pixels = np.concatenate([clip.pixels[frame] for clip in clips])
    drawn = _draw_mesh(image, vertices, pixels, np.concatenate(faces))
    for clip in clips:
        if clip.valid[frame]:
            draw_bones(drawn, clip.landmarks[frame], _FITTED)
    if dots is not None:
        draw_dots(drawn, dots[np.isfinite(dots).all(axis=1)], _TRACKED, 1.5)
    return drawn


def _draw_mesh(
    image: np.ndarray, vertices: np.ndarray, pixels: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Blend a mesh, vertices (V, 3) m at (V, 2) px, over an image, far triangles first."""
    triangles = vertices[faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    middles = triangles.mean(axis=1)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(middles, axis=1)
    facing = -(normals * middles).sum(axis=1) / np.maximum(lengths, 1e-20)
    places, shift = fixed_point(pixels)
    corners = np.array(places, dtype=np.int32)
    layer = image.copy()
    for face in np.argsort(-middles[:, 2]):
        if facing[face] > 0:
            shade = tuple((0.35 + 0.65 * facing[face]) * np.array(_MESH))
            cv2.fillConvexPoly(layer, corners[faces[face]], shade, cv2.LINE_8, shift)
    return cv2.addWeighted(layer, 0.6, image, 0.4, 0)
