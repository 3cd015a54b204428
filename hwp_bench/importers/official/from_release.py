"""From the tracker's hands to the capture's: MANO as it is, or the free hand by fitting.

The tracker poses the *right* MANO hand with the left hand's parameters, centres it on its middle
knuckle, negates x, and adds `root_rel` and the translation. The left parameters are therefore
those of a mirrored right hand: a rotation vector (x, y, z) becomes (x, -y, -z) in the left hand's
own frame. The translation is taken from the stored vertices in closed form, so that no convention
about the centre is assumed.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import sha256_file
from hwp_bench.base.images import is_blank, read_gray
from hwp_bench.base.text import bounded
from hwp_bench.capture import Cameras, CaptureInfo, identify_hand_model
from hwp_bench.capture.schema import check_id
from hwp_bench.hands import HandParameters, HandTemplate, load_template, pose_hand
from hwp_bench.hands.fitting import FitTargets, FittingSettings, fit_hand
from hwp_bench.hands.mano import FINGERTIPS
from hwp_bench.importers.official.crop import (
    MASK_THRESHOLD,
    CroppedFrame,
    crop_frames,
    tracked_joints,
)
from hwp_bench.importers.official.records import (
    OfficialFolder,
    OfficialRecords,
    SideRecords,
    read_records,
)
from hwp_bench.importers.shared.output import (
    ProjectedHand,
    overlay_sheet,
    project_hand,
    refuse_existing,
    sheet_frames,
    write_capture,
)
from hwp_bench.taxonomy import catalogue

#: Stored vertices that MANO misses by more than this (median frame, mm) mean that the file does
#: not follow the convention that is assumed, or was made with another hand model.
MAX_VERTEX_MM = 10.0
#: Rows of the 21 landmarks that are vertices: the finger tips.
_TIP_ROWS = [4, 8, 12, 16, 20]


@dataclass(frozen=True, eq=False)
class ImportedHand:
    """One hand in the capture's convention.

    Attributes:
        hand: its parameters.
        error_mm: (F,) mean distance from the tracker's vertices, mm; NaN where not valid.
    """

    hand: HandParameters
    error_mm: np.ndarray


def import_hands(
    records: OfficialRecords,
    sides: tuple[str, ...],
    centres: np.ndarray,
    model: str,
    *,
    compat: bool,
    where: str,
) -> dict[str, ImportedHand]:
    """Take the hands of a capture over, by side.

    Args:
        records: of the capture.
        sides: the hands that the capture has.
        centres: (F, 2) px, half the frames' sizes.
        model: the hand model, as `load_template` takes it: MANO is taken over, the free hand
            is fitted.
        compat: use the translations that the released loader uses.
        where: the folder, for messages.
    """
    mean = load_template(model, "right").mean_pose
    made = {}
    for side in sides:
        hand = _swapped(records, side) if compat else records.sides[side]
        template = load_template(model, side)
        if model.startswith("mano:"):
            made[side] = mano_hand(hand, template, mean, where=where)
        else:
            knuckle = hand.camera + (records.root_rel if side == "left" else 0.0)
            made[side] = free_hand(hand, template, records.focal, centres, knuckle)
    return made


def own_rotations(pose: np.ndarray, side: str) -> np.ndarray:
    """Rotation vectors of a hand in its own frame, from the tracker's.

    Args:
        pose: (F, 16, 3) axis-angle rad; a left hand's are those of a mirrored right hand.
        side: `right` or `left`.
    """
    return pose if side == "right" else pose * np.array([1.0, -1.0, -1.0])


def mano_hand(
    records: SideRecords, template: HandTemplate, right_mean: np.ndarray, *, where: str
) -> ImportedHand:
    """Take MANO's parameters over; one shape (the median) for the clip.

    Args:
        records: the tracker's hand.
        template: MANO of its side.
        right_mean: (45,) mean pose of the right MANO hand, which the tracker poses.
        where: the folder, for the message.

    Raises:
        BadInput: the posed hand is not where the stored vertices are.
    """
    valid = records.valid
    pose = np.where(valid[:, None, None], records.pose, 0.0)
    pose[:, 1:] += right_mean.reshape(15, 3)
    pose = own_rotations(pose, template.side)
    betas = np.median(records.shape[valid], axis=0)
    with torch.no_grad():
        posed = pose_hand(
            template.to_torch(torch.float64),
            torch.from_numpy(pose),
            torch.from_numpy(betas),
            torch.zeros(len(pose), 3, dtype=torch.float64),
        )
    gap = records.vertices - posed.vertices.numpy()
    transl = gap.mean(axis=1)
    error = 1000.0 * np.linalg.norm(gap - transl[:, None], axis=-1).mean(axis=1)
    median = float(np.median(error[valid]))
    if median > MAX_VERTEX_MM:
        raise BadInput(
            f"the {template.side} MANO hand misses the stored vertices by {median:.1f} mm in the "
            f"median frame, more than {MAX_VERTEX_MM:g}",
            where=where,
            field=f"verts3d_world_{template.side}",
            remedy="Is --mano the MANO of mano_v1_2? Otherwise this file follows another "
            "convention than the release; import it without --mano.",
        )
    return ImportedHand(HandParameters(pose, betas, transl, valid), np.where(valid, error, np.nan))


def free_hand(
    records: SideRecords,
    template: HandTemplate,
    focal: np.ndarray,
    centres: np.ndarray,
    knuckle: np.ndarray,
    settings: FittingSettings | None = None,
) -> ImportedHand:
    """Fit the free hand to the tracker's vertices and joints; MANO itself is not needed.

    Args:
        records: the tracker's hand.
        template: the free hand of its side.
        focal: (F,) px of the whole frame.
        centres: (F, 2) px, half the frames' sizes.
        knuckle: (F, 3) m, where the middle knuckle is.
        settings: steps and weights of the fit.
    """
    valid = records.valid
    landmarks = np.full((len(valid), 21, 3), np.nan)
    landmarks[:, _TIP_ROWS] = records.vertices[:, list(FINGERTIPS)]
    landmarks[:, 9] = knuckle
    offsets = (records.landmarks - centres[:, None]) / focal[:, None, None]
    rays = np.concatenate([offsets, np.ones((*offsets.shape[:2], 1))], axis=2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    pose = own_rotations(np.where(valid[:, None, None], records.pose, 0.0), template.side)
    zeros = torch.zeros(len(pose), 3, dtype=torch.float64)
    with torch.no_grad():
        posed = pose_hand(
            template.to_torch(torch.float64),
            torch.from_numpy(pose),
            torch.zeros(10, dtype=torch.float64),
            zeros,
        )
    transl = np.where(valid[:, None], knuckle - posed.landmarks[:, 9].numpy(), 0.0)
    start = HandParameters(pose, np.zeros(10), transl, valid)
    targets = FitTargets(landmarks, rays, records.vertices[:, ::2])
    fitted = fit_hand(template, targets, start, settings)
    return ImportedHand(fitted.parameters, fitted.skin_mm)


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


#: Fewest joints on the mask (mean share), and lead over the other hand, to decide.
MIN_SHARE, MIN_LEAD = 0.5, 0.1
#: Number of frames that are examined.
LOOKED_AT = 24


def unexpected(folder: OfficialFolder, records: OfficialRecords) -> list[str]:
    """List contradictions to the paper or the format that still let the records be used."""
    found = [f"unknown key {key!r} is not read" for key in records.unknown]
    if records.reordered:
        found.append("records were not in the order of their images; they are now")
    entry = catalogue().get(folder.id)
    if entry is None:
        found.append(f"{folder.id} is not one of the paper's captures: perturbations unknown")
        return found
    if (entry.hands == "single") != folder.single:
        found.append(f"the folder's name contradicts the paper: {folder.id} is {entry.hands}")
    most = -(-entry.frame_count // (folder.subsample or 1))
    if len(records.numbers) > most:
        found.append(f"{len(records.numbers)} frames, where the paper's count gives {most}")
    return found


def choose_sides(
    folder: OfficialFolder, records: OfficialRecords, hand: str | None
) -> tuple[tuple[str, ...], list[str]]:
    """Decide which hands the capture has.

    The tracker writes both hands in every capture. Of a single-hand capture it
    is the hand whose joints lie on the masks, unless `hand` names it.

    Args:
        folder: the folder.
        records: its records.
        hand: the user's choice, or None.

    Returns:
        The sides, and messages to the user about the choice.

    Raises:
        BadInput: a hand is missing or not finite in any frame, or the masks do not decide.
    """
    entry = catalogue().get(folder.id)
    single = entry.hands == "single" if entry else folder.single
    if not single:
        if set(records.sides) != {"right", "left"}:
            raise BadInput(
                f"has the {', '.join(records.sides)} hand only, for a capture of two",
                where=folder.path,
            )
        _need_valid(folder, records, ("right", "left"))
        return ("right", "left"), []
    if hand is not None:
        if hand not in records.sides:
            raise BadInput(f"has no {hand} hand", where=folder.path, field="--hand")
        _need_valid(folder, records, (hand,))
        return (hand,), []
    if len(records.sides) == 1:
        side = next(iter(records.sides))
        _need_valid(folder, records, (side,))
        return (side,), []
    shares = {side: _share_on_mask(records, side) for side in records.sides}
    side = max(shares, key=lambda name: shares[name])
    listed = ", ".join(f"{name} {share:.2f}" for name, share in shares.items())
    if shares[side] < MIN_SHARE or shares[side] - min(shares.values()) < MIN_LEAD:
        raise BadInput(
            f"the masks do not show which hand is in the image (share of joints on them: {listed})",
            where=folder.path,
            remedy="Name the hand with --hand.",
        )
    _need_valid(folder, records, (side,))
    return (side,), [f"{side} hand taken, by the share of joints on the masks: {listed}"]


def _need_valid(folder: OfficialFolder, records: OfficialRecords, sides: tuple[str, ...]) -> None:
    for side in sides:
        if not records.sides[side].valid.any():
            raise BadInput(f"the {side} hand is not finite in any frame", where=folder.path)


def _share_on_mask(records: OfficialRecords, side: str) -> float:
    """Mean share of a hand's joints that lie on the mask, over a few frames."""
    hand = records.sides[side]
    frames = np.flatnonzero(hand.valid)
    if not len(frames):
        return 0.0
    shares = []
    for frame in frames[np.unique(np.linspace(0, len(frames) - 1, LOOKED_AT).astype(int))]:
        mask = read_gray(records.masks[frame]) > MASK_THRESHOLD
        x, y = np.floor(hand.landmarks[frame].T).clip(-1, 1e6).astype(int)
        inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
        shares.append(
            np.mean(inside & mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)])
        )
    return float(np.mean(shares))


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
        dots = {frame: tracked[frame] for frame in shown}
        return overlay_sheet(list(clips.values()), images, masks, dots)

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
