"""Annotation files of InterHand2.6M, read for one camera of one sequence."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import check_is_file, inside, read_json
from hwp_bench.capture.schema import MAX_FRAMES
from hwp_bench.importers.interhand.sequences import SPLITS, InterHandSequence

#: Largest annotation file; the training part's `data` file has about 1 GB.
MAX_BYTES = 3 * 1024 * 1024 * 1024
#: The data set's joints of one hand in the order of our 21 landmarks (wrist, then each finger
#: from its base to its tip): it lists thumb to little finger from tip to base, the wrist last.
LANDMARK_ROWS = (20, 3, 2, 1, 0, 7, 6, 5, 4, 11, 10, 9, 8, 15, 14, 13, 12, 19, 18, 17, 16)
#: The file of MANO parameters, which comes apart from the others.
MANO = "MANO_NeuralAnnot"
#: First joint of each hand.
FIRST_JOINT = {"right": 0, "left": 21}


@dataclass(frozen=True, eq=False)
class ManoAnnotation:
    """MANO parameters of one hand in every frame, world frame.

    Attributes:
        pose: (F, 16, 3) axis-angle rad, relative to MANO's mean pose.
        shape: (F, 10).
        transl: (F, 3) m.
        valid: (F,) bool, false where the data set has none.
    """

    pose: np.ndarray
    shape: np.ndarray
    transl: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class InterHandRecords:
    """The annotations of one camera of one sequence.

    Attributes:
        split: part of the data set.
        frames: (F,) frame numbers, ascending.
        images: F image files.
        size: (width, height) px.
        sides: the hands that some frame shows.
        K: (3, 3) px.
        viewmat: (4, 4) world to camera, m.
        joints: (F, 21, 3) m, world, OpenPose order, by side; NaN where not valid.
        mano: MANO parameters by side.
    """

    split: str
    frames: np.ndarray
    images: tuple[Path, ...]
    size: tuple[int, int]
    sides: tuple[str, ...]
    K: np.ndarray
    viewmat: np.ndarray
    joints: Mapping[str, np.ndarray]
    mano: Mapping[str, ManoAnnotation]

    def select(self, kept: np.ndarray) -> InterHandRecords:
        """The annotations of some frames, (F,) bool."""
        mano = {
            side: ManoAnnotation(
                hand.pose[kept], hand.shape[kept], hand.transl[kept], hand.valid[kept]
            )
            for side, hand in self.mano.items()
        }
        return replace(
            self,
            frames=self.frames[kept],
            images=tuple(image for image, one in zip(self.images, kept, strict=True) if one),
            joints={side: joints[kept] for side, joints in self.joints.items()},
            mano=mano,
        )


def read_annotations(
    root: str | os.PathLike[str],
    sequence: InterHandSequence,
    side: str = "auto",
    *,
    mano: bool = True,
) -> InterHandRecords:
    """Read the annotations of one camera of one sequence.

    Args:
        root: the folder with `images/` and `annotations/`.
        sequence: which one.
        side: `right`, `left` or `both`; `auto`: the hands that the sequence is said to show.
        mano: whether MANO parameters are needed. If not, they are read where they are.

    Raises:
        BadInput: a file or field is missing or damaged, or no frame of the sequence is listed or
            shows that hand.
    """
    base = Path(root)
    split, data = _data(base, sequence)
    rows = _frames(data, sequence, base / "annotations" / split)
    folder = base / "images" / split
    images = tuple(_image(folder, row["file_name"]) for row in rows)
    frames = np.array([row["frame_idx"] for row in rows])
    types = {row["hand_type"] for row in rows}
    shown = {"right", "left"} if "interacting" in types else types & {"right", "left"}
    wanted = ("right", "left") if side in ("auto", "both") else (side,)
    if side != "auto" and not shown >= set(wanted):
        raise BadInput(
            f"shows the {' and the '.join(sorted(shown)) or 'no'} hand only",
            where=folder / f"Capture{sequence.capture}" / sequence.name,
            field="--side",
        )
    sides = tuple(side for side in wanted if side in shown)
    sizes = {(row["width"], row["height"]) for row in rows}
    if len(sizes) != 1 or not sides:
        raise BadInput(
            f"has frames of sizes {sorted(sizes)} and hands {sorted(types)}", where=folder
        )
    K, viewmat = _camera(base, split, sequence)
    keys = [str(frame) for frame in frames]
    return InterHandRecords(
        split=split,
        frames=frames,
        images=images,
        size=sizes.pop(),
        sides=sides,
        K=K,
        viewmat=viewmat,
        joints=_joints(base, split, sequence, keys, sides),
        mano=_mano(base, split, sequence, keys, sides, needed=mano),
    )


def _annotation(base: Path, split: str, kind: str) -> Path:
    return base / "annotations" / split / f"InterHand2.6M_{split}_{kind}.json"


def _data(base: Path, sequence: InterHandSequence) -> tuple[str, dict[str, Any]]:
    splits = (sequence.split,) if sequence.split else SPLITS
    for split in splits:
        folder = base / "images" / split / f"Capture{sequence.capture}" / sequence.name
        if not folder.is_dir():
            continue
        path = _annotation(base, split, "data")
        value = read_json(path, max_bytes=MAX_BYTES)
        if not isinstance(value, dict):
            raise BadInput("is not a JSON object", where=path)
        return split, value
    raise BadInput(
        f"does not contain images/*/Capture{sequence.capture}/{sequence.name}",
        where=base,
        remedy="Give the folder with images/ and annotations/ of InterHand2.6M.",
    )


def _frames(data: dict[str, Any], sequence: InterHandSequence, where: Path) -> list[dict[str, Any]]:
    chosen = {}
    for image in _list(data, "images", where):
        if (
            str(image.get("capture")) == str(sequence.capture)
            and image.get("seq_name") == sequence.name
            and str(image.get("camera")) == sequence.camera
        ):
            chosen[image.get("id")] = image
    types = {
        item.get("image_id"): item.get("hand_type")
        for item in _list(data, "annotations", where)
        if item.get("image_id") in chosen
    }
    rows = []
    for key, image in chosen.items():
        row = {**image, "hand_type": types.get(key)}
        for name in ("frame_idx", "width", "height"):
            try:
                row[name] = int(row[name])
            except (KeyError, TypeError, ValueError) as error:
                raise BadInput(f"image {key} does not have it", where=where, field=name) from error
        if not isinstance(row.get("file_name"), str):
            raise BadInput(f"image {key} does not have it", where=where, field="file_name")
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
        raise BadInput(f"lists a frame of {sequence.name} twice", where=where, field="frame_idx")
    return rows


def _list(data: dict[str, Any], name: str, where: Path) -> list[dict[str, Any]]:
    value = data.get(name)
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise BadInput("is not a list of objects", where=where, field=name)
    return value


def _image(folder: Path, name: str) -> Path:
    path = inside(folder, re.sub(r"^/+", "", name))
    check_is_file(path, remedy="Unpack the images of the sequence.")
    return path


def _of_capture(
    base: Path, split: str, kind: str, sequence: InterHandSequence
) -> tuple[Path, dict]:
    path = _annotation(base, split, kind)
    value = read_json(path, max_bytes=MAX_BYTES)
    found = value.get(str(sequence.capture)) if isinstance(value, dict) else None
    if not isinstance(found, dict):
        raise BadInput("is missing", where=path, field=str(sequence.capture))
    return path, found


def _camera(base: Path, split: str, sequence: InterHandSequence) -> tuple[np.ndarray, np.ndarray]:
    path, capture = _of_capture(base, split, "camera", sequence)

    def numbers(name: str, *shape: int) -> np.ndarray:
        table = capture.get(name)
        value = table.get(sequence.camera) if isinstance(table, dict) else None
        return _numbers(value, shape, path, f"{sequence.capture}.{name}.{sequence.camera}")

    position, rotation = numbers("campos", 3) / 1000.0, numbers("camrot", 3, 3)
    focal, centre = numbers("focal", 2), numbers("princpt", 2)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-2 or focal.min() <= 0:
        raise BadInput("is not a rotation, or a focal length is not above 0", where=path)
    # Written with six digits, it is a rotation only to about 1e-6: take the nearest one.
    left, _, right = np.linalg.svd(rotation)
    viewmat = np.eye(4)
    viewmat[:3, :3] = left @ right
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1.0]])
    return K, viewmat


def _joints(
    base: Path, split: str, sequence: InterHandSequence, keys: list[str], sides: tuple[str, ...]
) -> dict[str, np.ndarray]:
    path, capture = _of_capture(base, split, "joint_3d", sequence)
    found = {side: np.full((len(keys), 21, 3), np.nan) for side in sides}
    for index, key in enumerate(keys):
        frame = capture.get(key)
        if not isinstance(frame, dict):
            continue
        field = f"{sequence.capture}.{key}"
        world = _numbers(frame.get("world_coord"), (42, 3), path, f"{field}.world_coord") / 1000.0
        flags = _numbers(frame.get("joint_valid"), (42,), path, f"{field}.joint_valid", flat=True)
        for side in sides:
            rows = FIRST_JOINT[side] + np.array(LANDMARK_ROWS)
            # Joints that are not valid are filled with ones.
            found[side][index] = np.where(flags[rows, None] > 0, world[rows], np.nan)
    return found


def _mano(
    base: Path,
    split: str,
    sequence: InterHandSequence,
    keys: list[str],
    sides: tuple[str, ...],
    *,
    needed: bool,
) -> dict[str, ManoAnnotation]:
    if not needed and not _annotation(base, split, MANO).exists():
        nothing = {side: np.zeros((len(keys), 16, 3)) for side in sides}
        return {
            side: ManoAnnotation(
                pose, np.zeros((len(keys), 10)), pose[:, 0], np.zeros(len(keys), dtype=bool)
            )
            for side, pose in nothing.items()
        }
    path, capture = _of_capture(base, split, MANO, sequence)
    made = {}
    for side in sides:
        pose, shape, transl = (np.zeros((len(keys), n)) for n in (48, 10, 3))
        valid = np.zeros(len(keys), dtype=bool)
        for index, key in enumerate(keys):
            frame = capture.get(key)
            hand = frame.get(side) if isinstance(frame, dict) else None
            if hand is None:
                continue
            field = f"{sequence.capture}.{key}.{side}"
            if not isinstance(hand, dict):
                raise BadInput("is not a JSON object", where=path, field=field)
            for name, target in (("pose", pose), ("shape", shape), ("trans", transl)):
                length = (target.shape[1],)
                target[index] = _numbers(hand.get(name), length, path, f"{field}.{name}", flat=True)
            valid[index] = True
        made[side] = ManoAnnotation(pose.reshape(-1, 16, 3), shape, transl, valid)
    return made


def _numbers(
    value: Any, shape: tuple[int, ...], where: Path, field: str, *, flat: bool = False
) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadInput("is not a list of numbers", where=where, field=field) from error
    array = array.reshape(-1) if flat else array
    if array.shape != shape or not np.isfinite(array).all():
        raise BadInput(f"is not a finite array of shape {shape}", where=where, field=field)
    return array
