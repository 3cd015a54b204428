"""Make a capture of one camera of one sequence of InterHand2.6M.

Masks are silhouettes of the annotated hands: the data set has none. Parts of a hand that the other
hand hides are inside the one mask of a capture. Sleeves and marks on the skin are in it too.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadInput, UsageError, bounded
from hwp_bench.base.images import is_blank, read_rgb
from hwp_bench.capture import Cameras, CaptureInfo, identify_hand_model
from hwp_bench.capture.convert import with_one_shape
from hwp_bench.hands import HandParameters, HandTemplate, load_template, pose_hand
from hwp_bench.hands.fitting import FitTargets, fit_hand
from hwp_bench.hands.raster import draw_silhouette
from hwp_bench.importers.interhand.annotations import (
    InterHandRecords,
    ManoAnnotation,
    read_annotations,
)
from hwp_bench.importers.interhand.sequences import InterHandSequence
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.overlay import (
    ProjectedHand,
    posed_sheet,
    project_hand,
    sheet_frames,
)
from hwp_bench.importers.shared.windows import CropWindows, cut, follow_hands, resample
from hwp_bench.importers.shared.writing import refuse_existing, write_capture

#: The hands that can be asked for.
CHOICES = ("auto", "right", "left", "both")
#: Fewest frames of a capture.
FEWEST = 3
#: Terms of the data set.
LICENCE = "CC BY-NC 4.0 (InterHand2.6M)"


@dataclass(frozen=True)
class InterHandImport:
    """Choices of an import; checked when made.

    Raises:
        UsageError: a choice makes no sense.
    """

    #: MANO file or folder, or None to fit the free hand to the annotated joints.
    mano: Path | None = None
    #: Edge of the stored square frames, px.
    size: int = 256
    #: Frames per second of the annotated frames; the data set comes at 5 and at 30.
    fps: float = 5.0
    #: The hands that are imported: `right`, `left`, `both`, or `auto`: those that the data set
    #: says the sequence shows.
    side: str = "auto"
    #: Replace an existing capture.
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.side not in CHOICES:
            raise UsageError(f"must be one of {', '.join(CHOICES)}", field="--side")
        if not 32 <= self.size <= 2048:
            raise UsageError("must be 32 to 2048 px", field="--size")
        if not 0 < self.fps < 1000:
            raise UsageError("must be above 0 and below 1000", field="--fps")

    @property
    def model(self) -> str:
        """The hand model, as `load_template` takes it."""
        return "anny" if self.mano is None else f"mano:{Path(self.mano).absolute()}"


def import_interhand(
    root: str | os.PathLike[str],
    sequence: InterHandSequence,
    out: str | os.PathLike[str],
    options: InterHandImport | None = None,
) -> dict[str, Any]:
    """Make a capture of one camera of one sequence.

    Args:
        root: the folder with `images/` and `annotations/`.
        sequence: which one.
        out: the capture folder to make.
        options: choices; the defaults where None.

    Returns:
        Facts that measure the import: mean distance of the hand's joints from the annotated ones,
        mm, and of the vertices from their place before all frames got one shape, mm.

    Raises:
        BadInput: a file or field is missing or damaged, or a hand has no annotation.
        UsageError: `out` exists.
    """
    options = options or InterHandImport()
    refuse_existing(out, overwrite=options.overwrite)
    records = read_annotations(root, sequence, options.side, mano=options.mano is not None)
    records, black = _without_black_frames(records, root)
    templates = {side: load_template(options.model, side) for side in records.sides}
    hands, facts = {}, {"frames": len(records.frames), "hands": list(records.sides)}
    if black:
        facts["black_frames"] = black
    errors: dict[str, Any] = {}
    for side, template in templates.items():
        if options.mano is not None:
            hands[side], one_shape = _mano_hand(records.mano[side], template, side, root)
            errors[side] = {"one_shape_mm": round(float(np.nanmean(one_shape)), 3)}
        else:
            hands[side] = _free_hand(records, template, side, root)
            errors[side] = {}
        distance = _joint_distance(records.joints[side], template, hands[side])
        errors[side] |= {"joints_mm": distance, "frames_valid": int(hands[side].valid.sum())}
    windows = _windows(records, templates, hands, options)
    count = len(records.frames)
    Ks = np.stack([_shifted(records.K, windows, frame) for frame in range(count)])
    cameras = Cameras(Ks, np.tile(records.viewmat, (count, 1, 1)))
    clips = {
        side: project_hand(template, hands[side], cameras) for side, template in templates.items()
    }
    facts |= {"errors": errors, "crop_px": windows.side, "split": records.split}
    info = _info(records, sequence, facts, options)
    shown = set(sheet_frames(count))
    images: dict[int, np.ndarray] = {}
    masks: dict[int, np.ndarray] = {}

    def frames() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for frame, (image, mask) in enumerate(_frames(records, clips, windows)):
            if frame in shown:
                images[frame], masks[frame] = image, mask
            yield image, mask

    def sheet() -> np.ndarray:
        return posed_sheet(clips, images, masks)

    write_capture(out, info, hands, cameras, frames(), sheet, facts, overwrite=options.overwrite)
    return facts


def _without_black_frames(
    records: InterHandRecords, root: str | os.PathLike[str]
) -> tuple[InterHandRecords, list[int]]:
    """Leave out frames whose image is black, as the data set has some (its issue 125)."""
    height, width = records.size[::-1]
    kept = np.array([not is_blank(read_rgb(path, (height, width))) for path in records.images])
    black = [int(frame) for frame in records.frames[~kept]]
    if kept.sum() < FEWEST:
        raise BadInput(
            f"{len(black)} of {len(kept)} images of the sequence are black, or of one colour",
            where=root,
            remedy="Get the images again, or another camera of the sequence.",
        )
    if black:
        notice(
            f"warning: {len(black)} of {len(kept)} frames are black, or of one colour, and are "
            f"left out: {bounded(black)}."
        )
    return records.select(kept), black


def _no_annotation(what: str, side: str, root: str | os.PathLike[str]) -> BadInput:
    other = "left" if side == "right" else "right"
    return BadInput(
        f"the {side} hand has no {what} in any frame",
        where=root,
        remedy=f"Import the other hand alone: --side {other}.",
    )


def _mano_hand(
    mano: ManoAnnotation, template: HandTemplate, side: str, root: str | os.PathLike[str]
) -> tuple[HandParameters, np.ndarray]:
    """MANO as annotated: relative to the mean pose, each hand with its own model."""
    if not mano.valid.any():
        raise _no_annotation("MANO parameters", side, root)
    pose = mano.pose.copy()
    pose[:, 1:] += template.mean_pose.reshape(15, 3)
    return with_one_shape(template, pose, mano.shape, mano.transl, mano.valid)


def _free_hand(
    records: InterHandRecords, template: HandTemplate, side: str, root: str | os.PathLike[str]
) -> HandParameters:
    joints = records.joints[side]
    # A hand is placed by its wrist and knuckles; without them it cannot be placed.
    valid = np.isfinite(joints[:, [0, 5, 9, 17]]).all(axis=(1, 2))
    if not valid.any():
        raise _no_annotation("joints", side, root)
    mano = records.mano[side]
    pose = np.where(mano.valid[:, None, None], mano.pose, 0.0)
    zeros = np.zeros((len(pose), 3))
    posed = pose_hand(
        template.to_torch(torch.float64),
        torch.from_numpy(pose),
        torch.zeros(10, dtype=torch.float64),
        torch.from_numpy(zeros),
    )
    shift = np.where(valid[:, None], joints[:, 9] - posed.landmarks[:, 9].numpy(), 0.0)
    start = HandParameters(pose, np.zeros(10), shift, valid)
    return fit_hand(template, FitTargets(joints), start).parameters


def _joint_distance(
    joints: np.ndarray, template: HandTemplate, hand: HandParameters
) -> float | None:
    posed = pose_hand(
        template.to_torch(torch.float64),
        torch.from_numpy(hand.pose),
        torch.from_numpy(hand.betas),
        torch.from_numpy(hand.transl),
    )
    gaps = np.linalg.norm(posed.landmarks.numpy() - joints, axis=-1)[hand.valid]
    return round(1000.0 * float(np.nanmean(gaps)), 3) if np.isfinite(gaps).any() else None


def _windows(
    records: InterHandRecords,
    templates: Mapping[str, HandTemplate],
    hands: Mapping[str, HandParameters],
    options: InterHandImport,
) -> CropWindows:
    """One square of constant size that follows both hands, as for a video."""
    count = len(records.frames)
    whole = Cameras(np.tile(records.K, (count, 1, 1)), np.tile(records.viewmat, (count, 1, 1)))
    clips = {side: project_hand(templates[side], hand, whole) for side, hand in hands.items()}
    seen = np.any([hand.valid for hand in hands.values()], axis=0)
    points = []
    for side, clip in clips.items():
        valid = hands[side].valid[:, None, None]
        # A hand that is missing must not draw the window: the other one stands in for it.
        others = [clips[other].pixels[:, :1] for other in clips if other != side] or [
            clip.pixels[:, :1]
        ]
        points.append(np.where(valid, clip.pixels, others[0]))
    image = np.concatenate(points, axis=1)
    world = np.zeros((count, 21, 3))
    hand = Landmarks(image, world, seen.astype(float), seen)
    return follow_hands([hand], options.fps, options.size)


def _shifted(K: np.ndarray, windows: CropWindows, frame: int) -> np.ndarray:
    cropped = K.copy()
    cropped[:2, 2] -= windows.corners[frame]
    cropped[:2] *= windows.scale
    return cropped


def _info(
    records: InterHandRecords,
    sequence: InterHandSequence,
    facts: Mapping[str, Any],
    options: InterHandImport,
) -> CaptureInfo:
    shown = "both" if len(records.sides) == 2 else records.sides[0]
    return CaptureInfo(
        id=sequence.id,
        hands=shown,
        action=sequence.name,
        device=f"InterHand2.6M camera {sequence.camera}",
        fps=options.fps,
        width=options.size,
        height=options.size,
        frame_count=len(records.frames),
        hand_model=identify_hand_model(options.model, shown),
        perturbations={},
        source={
            "kind": "InterHand2.6M",
            "sequence": f"{records.split}/Capture{sequence.capture}/{sequence.name}",
            "camera": sequence.camera,
            "frames": records.frames.tolist(),
            "masks": "silhouette of the annotated hands",
            "import": dict(facts),
        },
        licence=LICENCE,
    )


def _frames(
    records: InterHandRecords, clips: Mapping[str, ProjectedHand], windows: CropWindows
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the cropped image and mask of every frame."""
    width, height = records.size
    whole_frame = np.full((height, width), 255, np.uint8)
    for frame, path in enumerate(records.images):
        corner = windows.corners[frame]
        whole = read_rgb(path, (height, width))
        mask = np.zeros((windows.size, windows.size), dtype=np.uint8)
        for clip in clips.values():
            if clip.valid[frame]:
                mask |= draw_silhouette(clip.pixels[frame], clip.faces, windows.size)
        # Outside the camera's frame no hand is visible.
        inside = resample(cut(whole_frame, corner, windows.side), windows.size)
        mask[inside < 255] = 0
        yield resample(cut(whole, corner, windows.side), windows.size), mask
