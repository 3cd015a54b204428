"""Captures of InterHand2.6M: the annotations of one camera of one sequence, and its images.

Masks are silhouettes of the annotated hands: the data set has none. Parts of a hand that the other
hand hides are inside the one mask of a capture. Sleeves and marks on the skin are in it too.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadInput, UsageError, bounded
from hwp_bench.base.files import check_is_file, inside, read_json
from hwp_bench.base.images import is_blank, read_rgb
from hwp_bench.capture import Cameras
from hwp_bench.capture.convert import with_one_shape
from hwp_bench.capture.folder import refuse_taken
from hwp_bench.capture.schema import MAX_FRAMES
from hwp_bench.hands import HandParameters, HandTemplate, load_template
from hwp_bench.hands.fitting import FitTargets
from hwp_bench.hands.poses import filled
from hwp_bench.hands.raster import draw_silhouette
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.importers.shared.frames import CropWindows, cut, follow_hands, resample
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.output import (
    CHOICES,
    ProjectedHand,
    ReleaseImport,
    check_choices,
    fit_free_hand,
    project_hand,
    write_capture,
)

#: Fewest frames of a capture.
FEWEST = 3
#: Terms of the data set.
LICENCE = "CC BY-NC 4.0 (InterHand2.6M)"
#: Parts of the data set.
SPLITS = ("train", "val", "test")
#: Largest annotation file; the training part's `data` file has about 1 GB.
MAX_BYTES = 3 * 1024 * 1024 * 1024
#: The data set's joints of one hand in the order of our 21 landmarks (wrist, then each finger
#: from its base to its tip): it lists thumb to little finger from tip to base, the wrist last.
LANDMARK_ROWS = (20, 3, 2, 1, 0, 7, 6, 5, 4, 11, 10, 9, 8, 15, 14, 13, 12, 19, 18, 17, 16)
# The file of MANO parameters, which comes apart from the others.
_MANO = "MANO_NeuralAnnot"
# First joint of each hand.
_FIRST_JOINT = {"right": 0, "left": 21}
_PATH = re.compile(r"(?:(train|val|test)/)?Capture(\d{1,4})/([A-Za-z0-9_.-]{1,80})/cam(\d{1,9})")


@dataclass(frozen=True)
class InterHandSequence:
    """One camera of one sequence."""

    #: Number of the capture.
    capture: int
    #: Name of the sequence.
    name: str
    #: Number of the camera.
    camera: str
    #: Part of the data set, or None: the first that has it.
    split: str | None = None

    @property
    def id(self) -> str:
        """Id of the HWP capture that is made of it."""
        return f"interhand-{self.capture}-{self.name}-{self.camera}"

    @property
    def folder(self) -> str:
        """Its folder in a part of the data set, without the camera."""
        return f"Capture{self.capture}/{self.name}"


#: The three sequences of the paper.
PAPER_SEQUENCES: Mapping[str, InterHandSequence] = MappingProxyType(
    {
        "touchrom-15": InterHandSequence(21, "0390_dh_touchROM", "400015"),
        "touchrom-16": InterHandSequence(21, "0390_dh_touchROM", "400016"),
        "handscratch-16": InterHandSequence(21, "0286_handscratch", "400016"),
    }
)


def find_sequence(name: str) -> InterHandSequence:
    """Look up a sequence."""
    if name in PAPER_SEQUENCES:
        return PAPER_SEQUENCES[name]
    match = _PATH.fullmatch(name.strip("/"))
    if match is None or match.group(3).strip(".") == "":
        raise UsageError(
            f"{name!r} is not a sequence",
            field="SEQUENCE",
            remedy=f"Use {', '.join(PAPER_SEQUENCES)}, or CaptureN/SEQUENCE/camID.",
        )
    return InterHandSequence(int(match.group(2)), match.group(3), match.group(4), match.group(1))


@dataclass(frozen=True, kw_only=True)
class InterHandImport(ReleaseImport):
    """Choices of an import, also those of `ReleaseImport`; checked when made."""

    #: Frames per second of the annotated frames; the data set comes at 5 and at 30.
    fps: float = 5.0
    #: One of `CHOICES`; `auto`: the hands that the data set says the sequence shows.
    side: str = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(
            ("--side", self.side in CHOICES, f"must be one of {', '.join(CHOICES)}"),
            ("--fps", 0 < self.fps < 1000, "must be above 0 and below 1000"),
        )


# --- Annotations


@dataclass(frozen=True, eq=False)
class ManoAnnotation:
    """MANO parameters of one hand in every frame, world frame."""

    #: (F, 16, 3) axis-angle rad, relative to MANO's mean pose.
    pose: np.ndarray
    #: (F, 10).
    shape: np.ndarray
    #: (F, 3) m.
    transl: np.ndarray
    #: (F,) bool, false where the data set has none.
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class InterHandRecords:
    """The annotations of one camera of one sequence."""

    #: Part of the data set.
    split: str
    #: (F,) frame numbers, ascending; and those of frames that are left out, as they are black.
    frames: np.ndarray
    black: list[int]
    #: F image files.
    images: tuple[Path, ...]
    #: (width, height) px.
    size: tuple[int, int]
    #: The hands that some frame shows.
    sides: tuple[str, ...]
    #: (3, 3) px.
    K: np.ndarray
    #: (4, 4) world to camera, m.
    viewmat: np.ndarray
    #: (F, 21, 3) m, world, OpenPose order, by side; NaN where not valid.
    joints: Mapping[str, np.ndarray]
    #: MANO parameters by side.
    mano: Mapping[str, ManoAnnotation]


class _Annotations:
    """The annotation files of the part of the data set that has a sequence."""

    def __init__(self, root: str | os.PathLike[str], sequence: InterHandSequence) -> None:
        self.root, self.sequence = Path(root), sequence
        splits = (sequence.split,) if sequence.split else SPLITS
        found = [one for one in splits if (self.root / "images" / one / sequence.folder).is_dir()]
        if not found:
            raise BadInput(
                f"does not contain images/*/{sequence.folder}",
                where=self.root,
                remedy="Give the folder with images/ and annotations/ of InterHand2.6M.",
            )
        self.split = found[0]
        self.images = self.root / "images" / self.split

    def path(self, kind: str) -> Path:
        """The file of a kind of annotations."""
        name = f"InterHand2.6M_{self.split}_{kind}.json"
        return self.root / "annotations" / self.split / name

    def of_capture(self, kind: str) -> _Record:
        """The content of the file of a kind for the sequence's capture."""
        whole = _Record(read_json(self.path(kind), max_bytes=MAX_BYTES), self.path(kind))
        return whole.part(str(self.sequence.capture))

    def frames(self) -> list[dict[str, Any]]:
        """The records of the annotated frames of the camera, by frame number."""
        sequence, path = self.sequence, self.path("data")
        data, where = _Record(read_json(path, max_bytes=MAX_BYTES), path), path.parent
        named = (str(sequence.capture), sequence.name, str(sequence.camera))
        chosen = {
            data.key(image, "id"): image
            for image in data.objects("images")
            if (str(image.get("capture")), image.get("seq_name"), str(image.get("camera"))) == named
        }
        types = {
            key: item.get("hand_type")
            for item in data.objects("annotations")
            if (key := data.key(item, "image_id")) in chosen
        }
        rows = []
        for key, image in chosen.items():
            row, field = {**image, "hand_type": types.get(key)}, "file_name"
            good = isinstance(row.get(field), str)
            try:
                for field in ("frame_idx", "width", "height") if good else ():
                    row[field] = int(row[field])
            except (KeyError, TypeError, ValueError):
                good = False
            if not good:
                raise BadInput(f"image {key} does not have it", where=where, field=field)
            if row["hand_type"] in ("right", "left", "interacting"):
                rows.append(row)
        if not 1 <= len(rows) <= MAX_FRAMES:
            raise BadInput(
                f"{len(rows)} annotated frames of {sequence.name}, camera {sequence.camera}",
                where=where,
                remedy="Is the sequence in this part of the data set?",
            )
        rows.sort(key=lambda row: row["frame_idx"])
        if len({row["frame_idx"] for row in rows}) < len(rows):
            said = f"lists a frame of {sequence.name} twice"
            raise BadInput(said, where=where, field="frame_idx")
        return rows

    def camera(self) -> tuple[np.ndarray, np.ndarray]:
        """Intrinsics (3, 3) px, and (4, 4) world to camera, m."""
        capture, camera = self.of_capture("camera"), self.sequence.camera
        position = capture.part("campos").numbers(camera, (3,)) / 1000.0
        rotation = capture.part("camrot").numbers(camera, (3, 3))
        focal = capture.part("focal").numbers(camera, (2,))
        centre = capture.part("princpt").numbers(camera, (2,))
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or focal.min() <= 0:
            said = "is not a rotation, or a focal length is not above 0"
            raise BadInput(said, where=capture.path)
        # Written with six digits, it is a rotation only to about 1e-6: take the nearest one.
        left, _, right = np.linalg.svd(rotation)
        viewmat = np.eye(4)
        viewmat[:3, :3] = left @ right
        viewmat[:3, 3] = -viewmat[:3, :3] @ position
        K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1.0]])
        return K, viewmat

    def joints(self, keys: list[str], sides: tuple[str, ...]) -> dict[str, np.ndarray]:
        """(F, 21, 3) m by side."""
        capture = self.of_capture("joint_3d")
        found = {side: np.full((len(keys), 21, 3), np.nan) for side in sides}
        for index, key in enumerate(keys):
            if not isinstance(capture.value.get(key), dict):
                continue
            frame = capture.part(key)
            world = frame.numbers("world_coord", (42, 3)) / 1000.0
            flags = frame.numbers("joint_valid", (42,), flat=True)
            for side in sides:
                rows = _FIRST_JOINT[side] + np.array(LANDMARK_ROWS)
                # Joints that are not valid are filled with ones.
                found[side][index] = np.where(flags[rows, None] > 0, world[rows], np.nan)
        return found

    def mano(
        self, keys: list[str], sides: tuple[str, ...], *, needed: bool
    ) -> dict[str, ManoAnnotation]:
        """MANO parameters by side; none valid if they are not needed and not there."""
        capture = _Record({}, self.path(_MANO))
        if needed or capture.path.exists():
            capture = self.of_capture(_MANO)
        made = {}
        for side in sides:
            pose, shape, transl = (np.zeros((len(keys), n)) for n in (48, 10, 3))
            valid = np.zeros(len(keys), dtype=bool)
            for index, key in enumerate(keys):
                frame = capture.value.get(key)
                if not isinstance(frame, dict) or frame.get(side) is None:
                    continue
                hand = capture.part(key).part(side)
                for name, target in (("pose", pose), ("shape", shape), ("trans", transl)):
                    target[index] = hand.numbers(name, (target.shape[1],), flat=True)
                valid[index] = True
            made[side] = ManoAnnotation(pose.reshape(-1, 16, 3), shape, transl, valid)
        return made


class _Record:
    """A JSON object of a file, and the field that it is."""

    def __init__(self, value: Any, path: Path, field: str | None = None) -> None:
        if not isinstance(value, dict):
            raise BadInput("is missing, or not a JSON object", where=path, field=field)
        self.value, self.path, self._field = value, path, field

    def part(self, name: str) -> _Record:
        """A JSON object in it."""
        return _Record(self.value.get(name), self.path, self._place(name))

    def objects(self, name: str) -> list[dict[str, Any]]:
        """A list of JSON objects in it."""
        value = self.value.get(name)
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise BadInput("is not a list of objects", where=self.path, field=self._place(name))
        return value

    def key(self, item: dict[str, Any], name: str) -> int | str:
        """The number or name by which an object in it is found."""
        value = item.get(name)
        if isinstance(value, int | str):
            return value
        said = f"is {str(value)[:40]!r}, not a number or a name"
        raise BadInput(said, where=self.path, field=self._place(name))

    def numbers(self, name: str, shape: tuple[int, ...], *, flat: bool = False) -> np.ndarray:
        """Numbers in it."""
        where, field = self.path, self._place(name)
        try:
            array = np.asarray(self.value.get(name), dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise BadInput("is not a list of numbers", where=where, field=field) from error
        array = array.reshape(-1) if flat else array
        if array.shape != shape or not np.isfinite(array).all():
            raise BadInput(f"is not a finite array of shape {shape}", where=where, field=field)
        return array

    def _place(self, name: str) -> str:
        return name if self._field is None else f"{self._field}.{name}"


def read_annotations(
    root: str | os.PathLike[str], sequence: InterHandSequence, side: str, *, mano: bool
) -> InterHandRecords:
    """Read the annotations of one camera of one sequence.

    `side` is `right`, `left` or `both`; `auto`: the hands that the sequence is listed with. MANO
    parameters that are not needed (`mano`) are read where they are.
    """
    files = _Annotations(root, sequence)
    rows = files.frames()
    images = tuple(inside(files.images, re.sub(r"^/+", "", row["file_name"])) for row in rows)
    for image in images:
        check_is_file(image, remedy="Unpack the images of the sequence.")
    types = {row["hand_type"] for row in rows}
    shown = {"right", "left"} if "interacting" in types else types & {"right", "left"}
    wanted = ("right", "left") if side in ("auto", "both") else (side,)
    if side != "auto" and not shown >= set(wanted):
        raise BadInput(
            f"shows the {' and the '.join(sorted(shown)) or 'no'} hand only",
            where=files.images / sequence.folder,
            field="--side",
        )
    sides = tuple(side for side in wanted if side in shown)
    sizes = {(row["width"], row["height"]) for row in rows}
    if len(sizes) != 1:
        raise BadInput(f"has frames of sizes {sorted(sizes)}", where=files.images)
    size = sizes.pop()
    # The data set has some black images (its issue 125).
    numbers = [row["frame_idx"] for row in rows]
    shows = [not is_blank(read_rgb(image, size[::-1])) for image in images]
    black = [number for number, good in zip(numbers, shows, strict=True) if not good]
    if sum(shows) < FEWEST:
        raise BadInput(
            f"{len(black)} of {len(rows)} images of the sequence are black, or of one colour",
            where=root,
            remedy="Get the images again, or another camera of the sequence.",
        )
    if black:
        notice(
            f"warning: {len(black)} of {len(rows)} frames are black, or of one colour, and are "
            f"left out: {bounded(black)}."
        )
    frames = np.array(numbers)[shows]
    keys = [str(frame) for frame in frames]
    return InterHandRecords(
        files.split,
        frames,
        black,
        tuple(itertools.compress(images, shows)),
        size,
        sides,
        *files.camera(),
        joints=files.joints(keys, sides),
        mano=files.mano(keys, sides, needed=mano),
    )


# --- The import


def import_interhand(
    root: str | os.PathLike[str],
    sequence: InterHandSequence,
    out: str | os.PathLike[str],
    options: InterHandImport | None = None,
) -> dict[str, Any]:
    """Make a capture of one camera of one sequence."""
    options = options or InterHandImport()
    refuse_taken(out, overwrite=options.overwrite)
    records = read_annotations(root, sequence, options.side, mano=options.mano is not None)
    count = len(records.frames)
    facts: dict[str, Any] = {"frames": count, "hands": list(records.sides)}
    if records.black:
        facts["black_frames"] = records.black
    templates = {side: load_template(options.model, side) for side in records.sides}
    hands: dict[str, HandParameters] = {}
    errors: dict[str, dict[str, Any]] = {}
    for side, template in templates.items():
        hand, errors[side] = _import_hand(records, template, options, root)
        hands[side] = filled(hand)
    viewmats = np.tile(records.viewmat, (count, 1, 1))

    def projected(Ks: np.ndarray) -> list[ProjectedHand]:
        cameras = Cameras(Ks, viewmats)
        return [project_hand(templates[side], hands[side], cameras) for side in hands]

    windows = _windows(projected(np.tile(records.K, (count, 1, 1))), options)
    cameras = Cameras(windows.intrinsics(records.K), viewmats)
    clips = projected(cameras.Ks)
    facts |= {"errors": errors, "crop_px": windows.side, "split": records.split}
    fps, times = _timing(records, options.fps)
    write_capture(
        out,
        hands,
        cameras,
        _cropped_frames(records, clips, windows),
        clips,
        facts,
        overwrite=options.overwrite,
        model=options.model,
        size=options.size,
        id=sequence.id,
        action=sequence.name,
        device=f"InterHand2.6M camera {sequence.camera}",
        fps=fps,
        times=times,
        perturbations={},
        source={
            "kind": "InterHand2.6M",
            "sequence": f"{records.split}/{sequence.folder}",
            "camera": sequence.camera,
            "frames": records.frames.tolist(),
            "masks": "silhouette of the annotated hands",
            "import": facts,
        },
        licence=LICENCE,
    )
    return facts


def _timing(records: InterHandRecords, fps: float) -> tuple[float, tuple[float, ...] | None]:
    """Mean rate of the frames, and their times where steps differ, as next to black frames.

    The usual step between the numbers of annotated frames is one of `fps` in a second.
    """
    usual = np.median(np.diff(np.sort([*records.frames, *records.black])))
    places = (records.frames - records.frames[0]) / usual
    rate, steps = fps * float((len(places) - 1) / places[-1]), np.diff(places)
    even = bool((steps == steps[0]).all())
    return rate, None if even else tuple(np.round(places / fps, 6).tolist())


def _import_hand(
    records: InterHandRecords,
    template: HandTemplate,
    options: InterHandImport,
    root: str | os.PathLike[str],
) -> tuple[HandParameters, dict[str, Any]]:
    """Take MANO over as annotated, or fit the free hand to the joints; with its errors."""
    side = template.side
    mano, joints = records.mano[side], records.joints[side]
    what, valid = "MANO parameters", mano.valid
    if options.mano is None:
        # A hand is placed by its wrist and knuckles; without them it cannot be placed.
        what, valid = "joints", np.isfinite(joints[:, [0, 5, 9, 17]]).all(axis=(1, 2))
    _refuse_unseen(valid, side, what, root)
    errors: dict[str, Any] = {}
    points = joints
    if options.mano is not None:
        # Relative to the mean pose, each hand with its own model.
        pose = mano.pose.copy()
        pose[:, 1:] += template.mean_pose.reshape(15, 3)
        annotated = pose, mano.shape, mano.transl
        hand, one_shape = with_one_shape(template, *annotated, valid)
        points = pose_parameters(template, hand).vertices.numpy()
    far = valid & ~_near_image(points, records)
    if far.any():
        errors["far_frames"] = records.frames[far].tolist()
        notice(
            f"warning: the {side} hand is annotated outside of the image, and counts as not "
            f"seen, in {far.sum()} of {len(far)} frames: {bounded(errors['far_frames'])}."
        )
        valid = valid & ~far
        _refuse_unseen(valid, side, f"{what} near the image", root)
    if options.mano is not None:
        if far.any():  # The one shape is that of the others.
            hand, one_shape = with_one_shape(template, *annotated, valid)
        errors["one_shape_mm"] = round(float(np.nanmean(one_shape)), 3)
    else:
        pose = np.where(mano.valid[:, None, None], mano.pose, 0.0)
        targets = FitTargets(joints)
        hand = fit_free_hand(template, pose, valid, joints[:, 9], targets).parameters
    posed = pose_parameters(template, hand).landmarks.numpy()
    gaps = np.linalg.norm(posed - joints, axis=-1)[hand.valid]
    known = np.isfinite(gaps).any()
    distance = round(1000.0 * float(np.nanmean(gaps)), 3) if known else None
    return hand, {**errors, "joints_mm": distance, "frames_valid": int(hand.valid.sum())}


def _refuse_unseen(valid: np.ndarray, side: str, what: str, root: str | os.PathLike[str]) -> None:
    """Refuse a hand that is in no frame."""
    if not valid.any():
        other = "left" if side == "right" else "right"
        raise BadInput(
            f"the {side} hand has no {what} in any frame",
            where=root,
            remedy=f"Import the other hand alone: --side {other}.",
        )


def _near_image(points: np.ndarray, records: InterHandRecords) -> np.ndarray:
    """(F,) bool: whether points (F, P, 3) m, world, are before the camera and in or near the image.

    As in a video, one of them lies in it, and none leaves it by more than the image's size: the
    windows of all frames are as large as the largest hand, so that one wrong annotation would make
    every hand tiny. A point that is NaN does not count.
    """
    local = (points @ records.viewmat[:3, :3].T + records.viewmat[:3, 3]) @ records.K.T
    pixels, size = local[..., :2] / np.maximum(local[..., 2:], 1e-9), np.array(records.size)
    near = (local[..., 2] > 0) & ((pixels > -size) & (pixels < 2 * size)).all(axis=-1)
    inside = ((pixels > 0) & (pixels < size)).all(axis=-1).any(axis=1)
    return np.asarray(inside & (near | np.isnan(local[..., 2])).all(axis=1))


def _windows(clips: list[ProjectedHand], options: InterHandImport) -> CropWindows:
    """One square of constant size that follows all hands in whole frames, as for a video."""
    seen = np.any([clip.valid for clip in clips], axis=0)
    points = []
    for index, clip in enumerate(clips):
        # A hand that is missing must not draw the window: the other one stands in for it.
        other = clips[index - 1].pixels[:, :1]
        points.append(np.where(clip.valid[:, None, None], clip.pixels, other))
    image = np.concatenate(points, axis=1)
    hand = Landmarks(image, np.zeros((len(image), 21, 3)), seen.astype(float), seen)
    return follow_hands([hand], options.fps, options.size)


def _cropped_frames(
    records: InterHandRecords, clips: list[ProjectedHand], windows: CropWindows
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the cropped image and mask of every frame."""
    width, height = records.size
    whole_frame = np.full((height, width), 255, np.uint8)
    for frame, path in enumerate(records.images):
        corner = windows.corners[frame]
        whole = read_rgb(path, (height, width))
        mask = np.zeros((windows.size, windows.size), dtype=np.uint8)
        for clip in clips:
            if clip.valid[frame]:
                mask |= draw_silhouette(clip.pixels[frame], clip.faces, windows.size)
        # Outside the camera's frame no hand is visible.
        in_frame = resample(cut(whole_frame, corner, windows.side), windows.size)
        mask[in_frame < 255] = 0
        yield resample(cut(whole, corner, windows.side), windows.size), mask
