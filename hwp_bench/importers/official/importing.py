"""Make a capture of one folder of the official release."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import sha256_file
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.base.progress import progress
from hwp_bench.capture import Cameras, CaptureInfo, CaptureWriter, HandModelId
from hwp_bench.capture.schema import check_id
from hwp_bench.hands import load_template
from hwp_bench.importers.official.choosing import choose_sides, unexpected
from hwp_bench.importers.official.crop import (
    CroppedFrame,
    box_of_landmarks,
    correct_crop,
    official_crop,
)
from hwp_bench.importers.official.folders import OfficialFolder
from hwp_bench.importers.official.hands import ImportedHand, free_hand, mano_hand
from hwp_bench.importers.official.records import OfficialRecords, SideRecords, read_records
from hwp_bench.importers.official.report import import_facts
from hwp_bench.importers.posed import PosedClip, pose_clip, posed_sheet, sheet_frames
from hwp_bench.taxonomy import catalogue

#: Terms of the release; the capture made of it may not be passed on under others.
LICENCE = "as the official HWP release (its authors' terms)"


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
    #: Which hand of a single-hand capture; None asks the masks.
    hand: str | None = None
    #: Edge of the stored frames, px.
    size: int = 256
    #: Frames per second of the video before it was thinned out; the release does not say.
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


def import_official(
    folder: OfficialFolder, out: str | os.PathLike[str], options: OfficialImport | None = None
) -> dict[str, Any]:
    """Make a capture of one folder of the release.

    Args:
        folder: what `find_folders` found.
        out: the capture folder to make.
        options: choices; the defaults where None.

    Returns:
        Facts by which to judge the import, as the capture's `extra/import.json` holds them;
        `warnings` lists what was not expected.

    Raises:
        UnsafePickle: a pickle asks for something that is not plain data.
        BadInput: a record, an image or a mask is unusable, or contradicts what is assumed.
        UsageError: `out` exists, or an option makes no sense.
    """
    options = options or OfficialImport()
    check_id(folder.id, os.fspath(folder.path))
    if Path(out).is_dir() and any(Path(out).iterdir()) and not options.overwrite:
        raise UsageError("exists already", where=out, remedy="Choose another place, or --force.")
    records = read_records(folder)
    warnings = unexpected(folder, records)
    sides, note = choose_sides(folder, records, options.hand)
    warnings += note
    crops, centres = _crops(records, options)
    hands = _hands(folder, records, sides, centres, options)
    cameras = Cameras(np.stack([c.K for c in crops]), np.tile(np.eye(4), (len(crops), 1, 1)))
    clips = {
        side: pose_clip(load_template(_model(options), side), made.hand, cameras)
        for side, made in hands.items()
    }
    tracked = _tracked(records, sides, crops, options.size)
    facts = import_facts(folder, records, hands, clips, tracked, crops, warnings, options)
    info = _info(folder, records, sides, facts, options)
    _write(out, info, hands, cameras, crops, clips, tracked, facts, options)
    return facts


def _crops(
    records: OfficialRecords, options: OfficialImport
) -> tuple[list[CroppedFrame], np.ndarray]:
    """Every frame's crop, and (F, 2) half the size of the whole frames."""

    def one(frame: int) -> tuple[CroppedFrame, tuple[float, float]]:
        picture = read_rgb(records.images[frame])
        mask = read_gray(records.masks[frame], picture.shape[:2])
        box = records.boxes[frame]
        if box is None and options.official_compat:
            # The loader then halves the intrinsics and leaves the frame as it is, which no
            # network of 256 px can take.
            raise BadInput(
                "has no bbox_inter, without which the released loader does not crop",
                where=records.images[frame],
                remedy="Import it without --official-compat.",
            )
        if box is None:
            seen = [hand.landmarks[frame] for hand in records.sides.values() if hand.valid[frame]]
            if not seen:
                raise BadInput("has neither a box nor a hand", where=records.images[frame])
            box = box_of_landmarks(np.concatenate(seen))
        crop = official_crop if options.official_compat else correct_crop
        height, width = picture.shape[:2]
        cropped = crop(picture, mask, box, float(records.focal[frame]), options.size)
        return cropped, (width / 2.0, height / 2.0)

    count = len(records.images)
    with ThreadPoolExecutor(4) as pool, progress("cropping frames", count) as update:
        crops, centres = [], []
        for done, (crop, centre) in enumerate(pool.map(one, range(count)), start=1):
            crops.append(crop)
            centres.append(centre)
            update(done)
    return crops, np.array(centres)


def _model(options: OfficialImport) -> str:
    return "anny" if options.mano is None else f"mano:{Path(options.mano).absolute()}"


def _hands(
    folder: OfficialFolder,
    records: OfficialRecords,
    sides: tuple[str, ...],
    centres: np.ndarray,
    options: OfficialImport,
) -> dict[str, ImportedHand]:
    mean = load_template(_model(options), "right").mean_pose
    made = {}
    for side in sides:
        hand = _swapped(records, side) if options.official_compat else records.sides[side]
        template = load_template(_model(options), side)
        if options.mano is not None:
            made[side] = mano_hand(hand, template, mean, where=os.fspath(folder.path))
        else:
            knuckle = hand.camera + (records.root_rel if side == "left" else 0.0)
            made[side] = free_hand(hand, template, records.focal, centres, knuckle)
    return made


def _swapped(records: OfficialRecords, side: str) -> SideRecords:
    """A hand with the other one's translation, as the released loader hands it to its network.

    The loader lists pose and shape as (right, left) and the translations as (left, right). Where
    the tracker gives both hands one translation, which it mostly does, nothing changes.
    """
    own = records.sides[side]
    other = records.sides.get("left" if side == "right" else "right")
    if other is None:
        return own
    moved = own.vertices - own.camera[:, None] + other.camera[:, None]
    return replace(own, vertices=moved, camera=other.camera, valid=own.valid & other.valid)


def _tracked(
    records: OfficialRecords, sides: tuple[str, ...], crops: list[CroppedFrame], size: int
) -> np.ndarray:
    """(F, 21 n, 2) px: the tracker's joints in the crops, NaN where not valid."""
    corners = np.array([crop.corner for crop in crops], dtype=np.float64)
    scales = size / np.array([crop.side for crop in crops], dtype=np.float64)
    points = []
    for side in sides:
        hand = records.sides[side]
        moved = (hand.landmarks - corners[:, None]) * scales[:, None, None]
        points.append(np.where(hand.valid[:, None, None], moved, np.nan))
    return np.concatenate(points, axis=1)


def _info(
    folder: OfficialFolder,
    records: OfficialRecords,
    sides: tuple[str, ...],
    facts: Mapping[str, Any],
    options: OfficialImport,
) -> CaptureInfo:
    entry = catalogue().get(folder.id)
    template = load_template(_model(options), sides[0])
    return CaptureInfo(
        id=folder.id,
        hands="both" if len(sides) == 2 else sides[0],
        action=entry.action if entry else "unknown",
        device=entry.device if entry else "unknown",
        fps=options.video_fps / (folder.subsample or 1),
        width=options.size,
        height=options.size,
        frame_count=len(records.numbers),
        hand_model=HandModelId(template.name, template.digest, _model(options)),
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


def _write(
    out: str | os.PathLike[str],
    info: CaptureInfo,
    hands: Mapping[str, ImportedHand],
    cameras: Cameras,
    crops: list[CroppedFrame],
    clips: Mapping[str, PosedClip],
    tracked: np.ndarray,
    facts: Mapping[str, Any],
    options: OfficialImport,
) -> None:
    import cv2

    shown = sheet_frames(len(crops))
    sheet = posed_sheet(
        clips,
        {frame: crops[frame].picture for frame in shown},
        {frame: crops[frame].mask for frame in shown},
        tracked,
    )
    parameters = {side: made.hand for side, made in hands.items()}
    with (
        CaptureWriter(out, info, parameters, cameras, overwrite=options.overwrite) as writer,
        progress("writing the capture", len(crops)) as update,
    ):
        for frame, crop in enumerate(crops):
            writer.frame(frame, crop.picture)
            writer.mask(frame, crop.mask)
            update(frame + 1)
        writer.extra("overlay.png", cv2.imencode(".png", sheet[:, :, ::-1])[1].tobytes())
        writer.extra("import.json", json.dumps(facts, indent=1) + "\n")
