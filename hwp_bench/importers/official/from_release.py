"""Make a capture of one folder of the official release.

Hands are MANO's as they are, or the free hand by fitting. The tracker poses the *right* MANO hand
with the left hand's parameters, centres it on its middle knuckle, negates x, and adds `root_rel`
and the translation. The left parameters are therefore those of a mirrored right hand: a rotation
vector (x, y, z) becomes (x, -y, -z) in the left hand's own frame. The translation is taken from the
stored vertices in closed form, so that no convention about the centre is assumed.

The released loader (`wildghand/data_single.py`, `data_multi.py`) differs in these points:

- It sends the pair of focal lengths through the crop's affine map as if it were a point. A focal
  length scales and does not shift, so its fx and fy are off by the map's translation
  (-scale * corner) and differ from each other.
- It makes the box square in integer arithmetic, which rounds centre and corner down.
- Its affine map puts the pixel centres of the image at integers, while the principal point
  is half the size, which is a half-pixel convention: image and camera differ by up to half
  a pixel of the crop.
- It samples the large frame at single points (bilinear, no low-pass), so crops are aliased.
- It changes the box in the loaded data in place: a frame that is read twice by one process has
  another crop the second time. `official_crop` gives the first.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.errors import BadInput, UsageError, bounded
from hwp_bench.base.files import sha256_file, sha256_json
from hwp_bench.base.images import is_blank, read_gray, read_rgb
from hwp_bench.capture import Cameras
from hwp_bench.capture.folder import refuse_taken
from hwp_bench.capture.schema import check_id
from hwp_bench.hands import HandParameters, HandTemplate, load_template
from hwp_bench.hands.fitting import FitTargets, FittedHand
from hwp_bench.hands.poses import filled, mirrored
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.hands.sources import FINGERTIPS
from hwp_bench.importers.official.records import (
    OfficialFolder,
    OfficialRecords,
    SideRecords,
    read_records,
)
from hwp_bench.importers.shared.frames import cells, cut, each_frame, resample
from hwp_bench.importers.shared.output import (
    ProjectedHand,
    ReleaseImport,
    check_choices,
    fit_free_hand,
    project_hand,
    read_report,
    write_capture,
)
from hwp_bench.taxonomy import catalogue

# --- Crop, mask and intrinsics of the frames: computed correctly, or as the released loader does

#: A mask pixel above this is hand, as in the released loader.
MASK_THRESHOLD = 100
#: The joints' box is enlarged by this, as where the release has a box.
BOX_SCALE = 1.5
#: Largest box, in longer edges of the image: that of a hand is wrong beyond.
MOST_BOX = 3.0


@dataclass(frozen=True, eq=False)
class CroppedFrame:
    """One frame of the capture."""

    #: (S, S, 3) uint8 sRGB.
    image: np.ndarray
    #: (S, S) uint8, 255 = hand.
    mask: np.ndarray
    #: (3, 3) px of the crop.
    K: np.ndarray
    #: (2,) px of the whole frame, top left corner of the crop.
    corner: np.ndarray
    #: Edge of the crop, px of the whole frame.
    side: float


def crop_frames(
    records: OfficialRecords, size: int, *, compat: bool
) -> tuple[list[CroppedFrame], np.ndarray]:
    """Crop every frame of a capture; with (F, 2) half the size of the whole frames, px.

    `size` is the edge of the crops, px; `compat` crops as the released loader does.
    """

    def one(frame: int) -> tuple[CroppedFrame, tuple[float, float]]:
        image, key = read_rgb(records.images[frame]), "bbox_inter"
        mask = read_gray(records.masks[frame], image.shape[:2])
        box = records.boxes[frame]
        if box is None and compat:
            # The loader then halves the intrinsics and leaves the frame as it is, which no
            # network of 256 px can take.
            raise BadInput(
                "has no bbox_inter, without which the released loader does not crop",
                where=records.images[frame],
                remedy="Import it without --official-compat.",
            )
        if box is None:
            seen = {
                side: hand.landmarks[frame].clip(-1e9, 1e9)
                for side, hand in records.sides.items()
                if hand.valid[frame]
            }
            if not seen:
                raise BadInput("has neither a box nor a hand", where=records.images[frame])
            key = f"joints2d_world_{max(seen, key=lambda side: np.abs(seen[side]).max())}"
            box = box_of_landmarks(np.concatenate(list(seen.values())))
        edge = float(max(box[2] - box[0], box[3] - box[1]))
        if edge > MOST_BOX * max(image.shape[:2]):
            raise BadInput(
                f"frame {records.numbers[frame]}: the hands' box is {edge:.0f} px large",
                where=records.images[frame],
                field=key,
                remedy="Correct the record, or leave it out.",
            )
        crop = official_crop if compat else correct_crop
        height, width = image.shape[:2]
        cropped = crop(image, mask, box, float(records.focal[frame]), size)
        return cropped, (width / 2.0, height / 2.0)

    count = len(records.images)
    crops, centres = [], []
    with progress("cropping frames", count) as update:
        for cropped, centre in each_frame(one, range(count)):
            crops.append(cropped)
            centres.append(centre)
            update(len(crops))
    return crops, np.array(centres)


def box_of_landmarks(landmarks: np.ndarray) -> np.ndarray:
    """The box that the release's pre-processing makes of joints (N, 2) px of all hands.

    (4,) int64 x1, y1, x2, y2: the joints' box, 1.5 times as large about its centre.
    """
    low, high = landmarks.min(axis=0), landmarks.max(axis=0)
    centre, half = (low + high) / 2, (high - low) * BOX_SCALE // 2
    return np.concatenate([centre - half, centre + half]).astype(np.int64)


def correct_crop(
    image: np.ndarray, mask: np.ndarray, box: np.ndarray, focal: float, size: int
) -> CroppedFrame:
    """Cut the smallest square of whole pixels about a box, black outside the image.

    The box is x1, y1, x2, y2, px; the focal length that of the whole frame, px, whose centre is the
    principal point. Crops are resampled, by area, to `size` px.
    """
    height, width = image.shape[:2]
    box = np.asarray(box, dtype=np.float64)
    side = int(np.ceil(max(box[2] - box[0], box[3] - box[1], 2.0)))
    corner = np.round((box[:2] + box[2:]) / 2 - side / 2).astype(np.int64)
    scale = size / side
    K = np.array([[focal * scale, 0, 0], [0, focal * scale, 0], [0, 0, 1.0]])
    K[:2, 2] = (np.array([width / 2, height / 2]) - corner) * scale
    binary = np.where(mask > MASK_THRESHOLD, 255, 0).astype(np.uint8)
    return CroppedFrame(
        resample(cut(image, corner, side), size),
        resample(cut(binary, corner, side), size),
        K,
        corner,
        side,
    )


def official_crop(
    image: np.ndarray, mask: np.ndarray, box: np.ndarray, focal: float, size: int
) -> CroppedFrame:
    """Crop as the released loader does; of the box the type matters, as in the loader."""
    import cv2

    height, width = image.shape[:2]
    square = np.array(box)
    square[2:] -= square[:2]
    edge = square[2:].max()
    centre = square[:2] + square[2:] / 2.0
    square[2:] = edge
    square[:2] = centre - edge / 2.0  # integers drop the half
    corner, side = square[:2].astype(np.float64), float(edge)
    scale = size / side
    shift = -scale * corner
    matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]], dtype=np.float32)

    def warp(pixels: np.ndarray) -> np.ndarray:
        return cv2.warpAffine(pixels, matrix, (size, size), flags=cv2.INTER_LINEAR)

    hand = warp((mask > MASK_THRESHOLD).astype(np.uint8)) > 0
    warped = np.round(warp(image.astype(np.float32))).clip(0, 255).astype(np.uint8)
    K = np.eye(3)
    K[0, 0], K[1, 1] = scale * focal + shift
    K[:2, 2] = scale * np.array([width / 2, height / 2]) + shift
    return CroppedFrame(
        np.where(hand[:, :, None], warped, 0).astype(np.uint8),
        np.where(hand, 255, 0).astype(np.uint8),
        K,
        corner,
        side,
    )


# --- The import

#: Terms of the release; the capture made of it may not be given away under other terms.
LICENCE = "as the official HWP release (its authors' terms)"
#: Joints that miss the tracker's by more than this share of the frame cause a warning.
FAR_JOINTS = 0.1
#: Stored vertices that MANO misses by more than this (median frame, mm) mean that the file does
#: not follow the convention that is assumed, or was made with another hand model.
MAX_VERTEX_MM = 10.0
# Rows of the 21 landmarks that are vertices: the finger tips.
_TIP_ROWS = [4, 8, 12, 16, 20]
# Fewest joints on the mask (mean share), and lead over the other hand, to decide; and number of
# frames that are examined.
_MIN_SHARE, _MIN_LEAD, _LOOKED_AT = 0.5, 0.1, 24


@dataclass(frozen=True, kw_only=True)
class OfficialImport(ReleaseImport):
    """Choices of an import, also those of `ReleaseImport`; checked when made."""

    #: Crop, intrinsics and translations as the released loader has them, mistakes included.
    official_compat: bool = False
    #: Which hand of a single-hand capture; None decides by the masks.
    hand: str | None = None
    #: Frames per second of the video before subsampling; the release does not state it.
    video_fps: float = 30.0

    def __post_init__(self) -> None:
        super().__post_init__()
        whole = not self.official_compat or self.size == 256
        check_choices(
            ("--side", self.hand in (None, "right", "left"), "must be right or left"),
            ("--fps", 0 < self.video_fps < 1000, "must be above 0 and below 1000"),
            ("--official-compat", whole, "means frames of 256 px"),
        )


def check_import(
    folder: OfficialFolder, out: str | os.PathLike[str], options: OfficialImport
) -> None:
    """Refuse before minutes of work what `import_official` refuses of its arguments."""
    check_id(folder.id, os.fspath(folder.path))
    refuse_taken(out, overwrite=options.overwrite)
    if options.hand is not None and not _is_single(folder):
        raise UsageError(
            f"{folder.id} shows two hands, and both are imported",
            where=folder.path,
            field="--side",
            remedy="Leave out --side, which names the hand of a single-hand capture.",
        )


def read_finished_import(
    folder: OfficialFolder, out: str | os.PathLike[str], options: OfficialImport
) -> dict[str, Any] | None:
    """Return the facts of an import that the same call has finished; None where it has not."""
    facts = None if options.overwrite else read_report(out)
    return facts if facts and facts.pop("call", None) == _call(folder, options) else None


def _call(folder: OfficialFolder, options: OfficialImport) -> str:
    """The digest of everything that a person gives an import, but for the hand model's files."""
    chosen = {**asdict(options), "mano": options.model, "overwrite": False}
    files = sorted(path for path in folder.path.rglob("*") if path.is_file())
    named = {path.relative_to(folder.path).as_posix(): sha256_file(path) for path in files}
    return sha256_json([chosen, folder.id, folder.subsample, folder.single, named])


def import_official(
    folder: OfficialFolder, out: str | os.PathLike[str], options: OfficialImport | None = None
) -> dict[str, Any]:
    """Make a capture of one folder of the release."""
    options = options or OfficialImport()
    check_import(folder, out, options)
    call = _call(folder, options)
    records = read_records(folder)
    warnings = _unexpected(folder, records)
    sides, note = _choose_sides(folder, records, options.hand)
    warnings += note
    crops, centres = crop_frames(records, options.size, compat=options.official_compat)
    hands = {side: _import_hand(records, side, centres, options, folder) for side in sides}
    blank = np.array([is_blank(crop.image) for crop in crops])
    if blank.any():
        numbers = records.numbers[blank].tolist()
        warnings.append(f"frames of one colour, as black ones, are not valid: {bounded(numbers)}")
        for side, hand in hands.items():
            valid = hand.parameters.valid & ~blank
            if not valid.any():
                said = f"the {side} hand is in frames of one colour only"
                raise BadInput(said, where=folder.path)
            hands[side] = replace(hand, parameters=replace(hand.parameters, valid=valid))
    cameras = Cameras(np.stack([c.K for c in crops]), np.tile(np.eye(4), (len(crops), 1, 1)))
    clips = {
        side: project_hand(load_template(options.model, side), made.parameters, cameras)
        for side, made in hands.items()
    }
    # The tracker's joints in the crops: (F, 21 * sides, 2) px, NaN where not valid.
    corners = np.array([crop.corner for crop in crops], dtype=np.float64)
    scales = options.size / np.array([crop.side for crop in crops], dtype=np.float64)
    tracked = np.concatenate(
        [
            np.where(
                records.sides[side].valid[:, None, None],
                (records.sides[side].landmarks - corners[:, None]) * scales[:, None, None],
                np.nan,
            )
            for side in sides
        ],
        axis=1,
    )
    facts = _facts(folder, records, hands, clips, tracked, crops, warnings, options)
    entry = catalogue().get(folder.id)
    write_capture(
        out,
        {side: filled(made.parameters) for side, made in hands.items()},
        cameras,
        ((crop.image, crop.mask) for crop in crops),
        list(clips.values()),
        {**facts, "call": call},
        overwrite=options.overwrite,
        model=options.model,
        size=options.size,
        tracked=tracked,
        id=folder.id,
        action=entry.action if entry else "unknown",
        device=entry.device if entry else "unknown",
        fps=options.video_fps / (folder.subsample or 1),
        perturbations=dict.fromkeys(entry.perturbations) if entry else {},
        source={
            "kind": "official HWP release",
            "folder": folder.path.absolute().name,
            "pickles": {path.name: sha256_file(path) for path in folder.pickles},
            "subsample": folder.subsample,
            "video_fps": {"value": options.video_fps, "from": "assumed, or given by the user"},
            "frames": records.numbers.tolist(),
            "focal": records.focal.tolist(),
            "import": facts,
        },
        licence=LICENCE,
    )
    return facts


def _facts(
    folder: OfficialFolder,
    records: OfficialRecords,
    hands: Mapping[str, FittedHand],
    clips: Mapping[str, ProjectedHand],
    tracked: np.ndarray,
    crops: list[CroppedFrame],
    warnings: list[str],
    options: OfficialImport,
) -> dict[str, Any]:
    """Measure the hands against the records; what looks wrong is added to `warnings`.

    As JSON: mean distance from the tracker's vertices (mm) and joints (px of the crop), share of
    the vertices on the masks, and the warnings.
    """
    gaps, on_mask = {}, {}
    for index, (side, clip) in enumerate(clips.items()):
        valid = hands[side].parameters.valid
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
        "frames_valid": {side: int(made.parameters.valid.sum()) for side, made in hands.items()},
        "vertex_error_mm": {
            side: round(float(np.nanmean(made.skin_mm)), 3) for side, made in hands.items()
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
        rows, columns, inside = cells(clip.pixels[frame], mask.shape)
        if inside.any():
            shares.append(float((mask[rows[inside], columns[inside]] > 127).mean()))
    return float(np.mean(shares)) if shares else 0.0


# --- Which hands a capture has


def _unexpected(folder: OfficialFolder, records: OfficialRecords) -> list[str]:
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


def _is_single(folder: OfficialFolder) -> bool:
    """Whether a capture is of one hand: by the paper, or by the folder's name."""
    entry = catalogue().get(folder.id)
    return entry.hands == "single" if entry else folder.single


def _choose_sides(
    folder: OfficialFolder, records: OfficialRecords, hand: str | None
) -> tuple[tuple[str, ...], list[str]]:
    """Decide which hands the capture has; with messages to the user about the choice.

    The tracker writes both hands in every capture. Of a single-hand capture it
    is the hand whose joints lie on the masks, unless `hand` names it.
    """
    note: list[str] = []
    sides: tuple[str, ...] = tuple(records.sides)
    if not _is_single(folder):
        if set(sides) != {"right", "left"}:
            raise BadInput(
                f"has the {', '.join(sides)} hand only, for a capture of two", where=folder.path
            )
        sides = ("right", "left")
    elif hand is not None:
        if hand not in sides:
            raise BadInput(f"has no {hand} hand", where=folder.path, field="--side")
        sides = (hand,)
    elif len(sides) == 2:
        shares = {side: _share_on_mask(records, side) for side in sides}
        side = max(shares, key=lambda name: shares[name])
        listed = ", ".join(f"{name} {share:.2f}" for name, share in shares.items())
        if shares[side] < _MIN_SHARE or shares[side] - min(shares.values()) < _MIN_LEAD:
            raise BadInput(
                "the masks do not show which hand is in the image (share of joints on them: "
                f"{listed})",
                where=folder.path,
                remedy="Name the hand with --side.",
            )
        sides, note = (side,), [f"{side} hand taken, by the share of joints on the masks: {listed}"]
    for side in sides:
        if not records.sides[side].valid.any():
            raise BadInput(f"the {side} hand is not finite in any frame", where=folder.path)
    return sides, note


def _share_on_mask(records: OfficialRecords, side: str) -> float:
    """Mean share of a hand's joints that lie on the mask, over a few frames."""
    hand = records.sides[side]
    frames = np.flatnonzero(hand.valid)
    if not len(frames):
        return 0.0
    shares = []
    for frame in frames[np.unique(np.linspace(0, len(frames) - 1, _LOOKED_AT).astype(int))]:
        mask = read_gray(records.masks[frame]) > MASK_THRESHOLD
        rows, columns, inside = cells(hand.landmarks[frame], mask.shape)
        shares.append(np.mean(inside & mask[rows, columns]))
    return float(np.mean(shares))


# --- Hands


def _import_hand(
    records: OfficialRecords,
    side: str,
    centres: np.ndarray,
    options: OfficialImport,
    folder: OfficialFolder,
) -> FittedHand:
    """Take a hand over: MANO as it is, else the free hand fitted.

    `centres` are (F, 2) px, half the frames' sizes.
    """
    hand = records.sides[side]
    opposite = "left" if side == "right" else "right"
    other = records.sides.get(opposite)
    if options.official_compat and other is not None:
        # The released loader lists pose and shape as (right, left) and the translations as (left,
        # right): its network gets a hand with the other one's. Where the tracker gives both hands
        # one translation, which it mostly does, nothing changes.
        moved = hand.vertices - hand.camera[:, None] + other.camera[:, None]
        both = hand.valid & other.valid
        if not both.any():
            raise BadInput(
                f"no frame has a finite {side} and {opposite} hand, and the released loader gives "
                "each the other's translation",
                where=folder.path,
                field=f"cam_aligned_{opposite}",
                remedy="Import it without --official-compat.",
            )
        hand = replace(hand, vertices=moved, camera=other.camera, valid=both)
    template = load_template(options.model, side)
    if options.mano is not None:
        mean = load_template(options.model, "right").mean_pose
        return _mano_hand(hand, template, mean, where=folder.path)
    knuckle = hand.camera + (records.root_rel if side == "left" else 0.0)
    return _free_hand(hand, template, records.focal, centres, knuckle)


def _own_rotations(pose: np.ndarray, side: str) -> np.ndarray:
    """Rotation vectors (F, 16, 3) of a hand in its own frame, of the tracker's."""
    return pose if side == "right" else mirrored(pose)


def _mano_hand(
    records: SideRecords, template: HandTemplate, right_mean: np.ndarray, *, where: Path
) -> FittedHand:
    """Take MANO's parameters over; one shape (the median) for the clip.

    `right_mean` is the (45,) mean pose of the right MANO hand, which the tracker poses.
    """
    valid = records.valid
    pose = np.where(valid[:, None, None], records.pose, 0.0)
    pose[:, 1:] += right_mean.reshape(15, 3)
    pose = _own_rotations(pose, template.side)
    betas = np.median(records.shape[valid], axis=0)
    unplaced = HandParameters(pose, betas, np.zeros((len(pose), 3)), valid)
    gap = records.vertices - pose_parameters(template, unplaced).vertices.numpy()
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
    distance = np.where(valid, error, np.nan)
    return FittedHand(replace(unplaced, transl=transl), np.full(len(pose), np.nan), distance)


def _free_hand(
    records: SideRecords,
    template: HandTemplate,
    focal: np.ndarray,
    centres: np.ndarray,
    knuckle: np.ndarray,
) -> FittedHand:
    """Fit the free hand to the tracker's vertices and joints; MANO itself is not needed.

    `focal` (F,) and `centres` (F, 2) are px of the whole frame, `knuckle` (F, 3) m is the middle
    one.
    """
    valid = records.valid
    landmarks = np.full((len(valid), 21, 3), np.nan)
    landmarks[:, _TIP_ROWS] = records.vertices[:, list(FINGERTIPS)]
    landmarks[:, 9] = knuckle
    offsets = (records.landmarks - centres[:, None]) / focal[:, None, None]
    rays = np.concatenate([offsets, np.ones((*offsets.shape[:2], 1))], axis=2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    pose = _own_rotations(np.where(valid[:, None, None], records.pose, 0.0), template.side)
    targets = FitTargets(landmarks, rays, records.vertices[:, ::2])
    return fit_free_hand(template, pose, valid, knuckle, targets)
