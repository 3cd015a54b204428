"""Make a capture of one folder of the official release."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import UsageError, bounded
from hwp_bench.base.files import sha256_file
from hwp_bench.base.images import is_blank
from hwp_bench.capture import Cameras, CaptureInfo, identify_hand_model
from hwp_bench.capture.schema import check_id
from hwp_bench.hands import load_template
from hwp_bench.importers.official.crop import CroppedFrame, crop_frames, tracked_joints
from hwp_bench.importers.official.folders import OfficialFolder
from hwp_bench.importers.official.hands import ImportedHand, import_hands
from hwp_bench.importers.official.release_records import OfficialRecords, read_records
from hwp_bench.importers.official.sides import choose_sides, unexpected
from hwp_bench.importers.shared.overlay import (
    ProjectedHand,
    posed_sheet,
    project_hand,
    sheet_frames,
)
from hwp_bench.importers.shared.writing import refuse_existing, write_capture
from hwp_bench.taxonomy import catalogue

#: Terms of the release; the capture made of it may not be given away under other terms.
LICENCE = "as the official HWP release (its authors' terms)"
#: Joints that miss the tracker's by more than this share of the frame cause a warning.
FAR_JOINTS = 0.1


@dataclass(frozen=True)
class OfficialImport:
    """Choices of an import; checked when made.

    Raises:
        UsageError: a choice makes no sense.
    """

    #: MANO file or folder, or None to fit the free hand.
    mano: Path | None = None
    #: Crop, intrinsics and translations as the released loader has them, mistakes included.
    official_compat: bool = False
    #: Which hand of a single-hand capture; None decides by the masks.
    hand: str | None = None
    #: Edge of the stored frames, px.
    size: int = 256
    #: Frames per second of the video before subsampling; the release does not state it.
    video_fps: float = 30.0
    #: Replace an existing capture.
    overwrite: bool = False

    def __post_init__(self) -> None:
        rules = (
            ("--hand", self.hand in (None, "right", "left"), "must be right or left"),
            ("--size", 32 <= self.size <= 2048, "must be 32 to 2048 px"),
            ("--fps", 0 < self.video_fps < 1000, "must be above 0 and below 1000"),
            (
                "--official-compat",
                not self.official_compat or self.size == 256,
                "means frames of 256 px",
            ),
        )
        for option, good, problem in rules:
            if not good:
                raise UsageError(problem, field=option)

    @property
    def model(self) -> str:
        """The hand model, as `load_template` takes it."""
        return "anny" if self.mano is None else f"mano:{Path(self.mano).absolute()}"


def import_official(
    folder: OfficialFolder, out: str | os.PathLike[str], options: OfficialImport | None = None
) -> dict[str, Any]:
    """Make a capture of one folder of the release.

    Args:
        folder: from `find_folders`.
        out: the capture folder to make.
        options: choices; the defaults where None.

    Returns:
        Facts that measure the import, as the capture's `extra/import.json` holds them;
        `warnings` lists everything unexpected.

    Raises:
        UnsafePickle: a pickle asks for something that is not plain data.
        BadInput: a record, an image or a mask is unusable, or contradicts an assumption.
        UsageError: `out` exists, or an option makes no sense.
    """
    options = options or OfficialImport()
    check_id(folder.id, os.fspath(folder.path))
    refuse_existing(out, overwrite=options.overwrite)
    records = read_records(folder)
    warnings = unexpected(folder, records)
    sides, note = choose_sides(folder, records, options.hand)
    warnings += note
    crops, centres = crop_frames(records, options.size, compat=options.official_compat)
    hands = import_hands(
        records,
        sides,
        centres,
        options.model,
        compat=options.official_compat,
        where=os.fspath(folder.path),
    )
    blank = np.array([is_blank(crop.image) for crop in crops])
    if blank.any():
        numbers = records.numbers[blank].tolist()
        warnings.append(f"frames of one colour, as black ones, are not valid: {bounded(numbers)}")
        hands = {side: _without(made, blank) for side, made in hands.items()}
    cameras = Cameras(np.stack([c.K for c in crops]), np.tile(np.eye(4), (len(crops), 1, 1)))
    clips = {
        side: project_hand(load_template(options.model, side), made.hand, cameras)
        for side, made in hands.items()
    }
    tracked = tracked_joints(records, sides, crops, options.size)
    facts = import_facts(folder, records, hands, clips, tracked, crops, warnings, options)
    info = _info(folder, records, sides, facts, options)
    shown = sheet_frames(len(crops))

    def sheet() -> np.ndarray:
        images = {frame: crops[frame].image for frame in shown}
        masks = {frame: crops[frame].mask for frame in shown}
        return posed_sheet(clips, images, masks, tracked)

    write_capture(
        out,
        info,
        {side: made.hand for side, made in hands.items()},
        cameras,
        ((crop.image, crop.mask) for crop in crops),
        sheet,
        facts,
        overwrite=options.overwrite,
    )
    return facts


def _without(made: ImportedHand, frames: np.ndarray) -> ImportedHand:
    """The same hand, not valid in some frames, (F,) bool."""
    return replace(made, hand=replace(made.hand, valid=made.hand.valid & ~frames))


def _info(
    folder: OfficialFolder,
    records: OfficialRecords,
    sides: tuple[str, ...],
    facts: Mapping[str, Any],
    options: OfficialImport,
) -> CaptureInfo:
    entry = catalogue().get(folder.id)
    shown = "both" if len(sides) == 2 else sides[0]
    return CaptureInfo(
        id=folder.id,
        hands=shown,
        action=entry.action if entry else "unknown",
        device=entry.device if entry else "unknown",
        fps=options.video_fps / (folder.subsample or 1),
        width=options.size,
        height=options.size,
        frame_count=len(records.numbers),
        hand_model=identify_hand_model(options.model, shown),
        perturbations=dict.fromkeys(entry.perturbations) if entry else {},
        source={
            "kind": "official HWP release",
            "folder": folder.path.absolute().name,
            "pickles": {path.name: sha256_file(path) for path in folder.pickles},
            "subsample": folder.subsample,
            "video_fps": {"value": options.video_fps, "from": "assumed, or given by the user"},
            "frames": records.numbers.tolist(),
            "focal": records.focal.tolist(),
            "import": dict(facts),
        },
        licence=LICENCE,
    )


def import_facts(
    folder: OfficialFolder,
    records: OfficialRecords,
    hands: Mapping[str, ImportedHand],
    clips: Mapping[str, ProjectedHand],
    tracked: np.ndarray,
    crops: list[CroppedFrame],
    warnings: list[str],
    options: OfficialImport,
) -> dict[str, Any]:
    """Measure the hands against the records; what looks wrong is added to `warnings`.

    Returns:
        JSON: mean distance from the tracker's vertices (mm) and joints (px of the crop), share
        of the vertices on the masks, and the warnings.
    """
    gaps, on_mask = {}, {}
    for index, (side, clip) in enumerate(clips.items()):
        valid = hands[side].hand.valid
        gap = np.linalg.norm(clip.landmarks - tracked[:, 21 * index : 21 * index + 21], axis=-1)
        gaps[side] = round(float(gap[valid].mean()), 3)
        on_mask[side] = round(_vertices_on_masks(clip, crops, valid), 4)
        if gaps[side] > FAR_JOINTS * options.size:
            warnings.append(
                f"the {side} hand's joints lie {gaps[side]:.0f} px from joints2d_world_{side}: "
                "focal length or principal point may follow another convention"
            )
    return {
        "capture": folder.id,
        "frames": len(records.numbers),
        "subsample": folder.subsample,
        "hands": list(hands),
        "hand_model": "anny" if options.mano is None else "mano",
        "official_compat": options.official_compat,
        "frames_valid": {side: int(made.hand.valid.sum()) for side, made in hands.items()},
        "vertex_error_mm": {
            side: round(float(np.nanmean(made.error_mm)), 3) for side, made in hands.items()
        },
        "joint_error_px": gaps,
        "vertices_on_mask": on_mask,
        "warnings": warnings,
    }


def _vertices_on_masks(clip: ProjectedHand, crops: list[CroppedFrame], valid: np.ndarray) -> float:
    """Mean share of projected vertices that lie on the hand's mask, of those in the image."""
    shares = []
    for frame in np.flatnonzero(valid):
        mask = crops[frame].mask
        x, y = np.floor(clip.pixels[frame].T).clip(-1, 1e6).astype(int)
        inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
        if inside.any():
            shares.append(float((mask[y[inside], x[inside]] > 127).mean()))
    return float(np.mean(shares)) if shares else 0.0
