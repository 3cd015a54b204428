"""Folders of the release, and the frame records of their pickles, checked key by key."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.base.unpickle import load_pickle
from hwp_bench.capture.schema import MAX_FRAMES
from hwp_bench.taxonomy import catalogue

_NAME = re.compile(r"(capture\d+)(?:_subsample(\d+))?(_single)?")
_SEPARATORS = re.compile(r"[\\/]+")


@dataclass(frozen=True)
class OfficialFolder:
    """One folder of the release."""

    #: The folder.
    path: Path
    #: Its pickles (`output*.pkl`), in the order of their names; together they are one capture.
    pickles: tuple[Path, ...]
    #: Id of the capture, a key of the catalogue where the folder's name contains one.
    id: str
    #: Step between the frames that were kept of the video, or None where the name has none.
    subsample: int | None
    #: Whether one hand was tracked, according to the name.
    single: bool


def find_folders(
    path: str | os.PathLike[str], identifier: str | None = None
) -> list[OfficialFolder]:
    """Find the captures of a folder: itself, or its subfolders down to the third level."""
    root = Path(path)
    if not root.is_dir():
        raise BadInput("is not a folder", where=root)
    deeper = ("*", "*/*", "*/*/*")
    below = sorted({file.parent for level in deeper for file in root.glob(f"{level}/output*.pkl")})
    candidates = [root] if _pickles(root) else below
    if not candidates:
        raise BadInput(
            "contains no output.pkl, also not in its subfolders",
            where=root,
            remedy="Give a folder of the release, such as capture0_subsample3_single.",
        )
    if identifier is not None and len(candidates) > 1:
        raise BadInput("holds several captures, which cannot have one id", where=root, field="--id")
    folders = [_folder(candidate, identifier) for candidate in candidates]
    for index, folder in enumerate(folders):
        for other in folders[:index]:
            if other.id == folder.id:
                raise BadInput(
                    f"holds {folder.id} twice: {other.path.name} and {folder.path.name}",
                    where=root,
                    remedy="Import them one by one.",
                )
    return folders


def _pickles(folder: Path) -> tuple[Path, ...]:
    return tuple(sorted(folder.glob("output*.pkl")))


def _folder(path: Path, identifier: str | None) -> OfficialFolder:
    name = path.absolute().name
    match = _NAME.fullmatch(name)
    if identifier is None and (match is None or match.group(1) not in catalogue()):
        raise BadInput(
            f"{name!r} is not a name of the release (captureN_subsampleK, N from 0 to 10, "
            "for one hand with _single)",
            where=path,
            remedy="Name the capture with --id.",
        )
    return OfficialFolder(
        path=path,
        pickles=_pickles(path),
        id=identifier or (match.group(1) if match else name),
        subsample=int(match.group(2)) if match and match.group(2) else None,
        single=bool(match and match.group(3)),
    )


def find_file(folder: Path, named: str, *, where: Path, field: str) -> Path:
    """Find a file that a pickle names, only in the pickle's own folder.

    The paths in the release belong to its authors' machine. The last parts of the name are
    searched for below the folder, as many of them as lead to a file. No name can lead out of the
    folder.
    """
    parts = [part for part in _SEPARATORS.split(named) if part not in ("", ".", "..")]
    for first in range(len(parts)):
        candidate = folder.joinpath(*parts[first:])
        if candidate.is_file():
            return candidate
    raise BadInput(
        f"names {named[-80:]!r}, which is not in {folder}",
        where=where,
        field=field,
        remedy="Put the images and masks of the release next to its pickle.",
    )


# --- Frame records

#: Largest pickle that is read, bytes: each record holds a mask of the whole frame.
MAX_PICKLE_BYTES = 4 * 1024 * 1024 * 1024
#: Keys of one hand, and their shapes without the batch axis of 1.
SIDE_KEYS: Mapping[str, tuple[int, ...]] = {
    "mano_pose": (48,),
    "mano_shape": (10,),
    "verts3d_world": (778, 3),
    "cam_aligned": (3,),
    "joints2d_world": (21, 2),
}
#: Keys that belong to the frame.
FRAME_KEYS = (
    "img_path",
    "scaled_focal_length",
    "root_rel",
    "mask_sam1_path",
    "bbox_inter",
    "mask_bbox",
)


@dataclass(frozen=True, eq=False)
class SideRecords:
    """One hand in every frame, as the tracker wrote it."""

    #: (F, 16, 3) axis-angle rad, relative to MANO's mean pose; of a left hand in the mirrored
    #: right-hand convention.
    pose: np.ndarray
    #: (F, 10).
    shape: np.ndarray
    #: (F, 778, 3) m, in camera axes: `verts3d_world` + `cam_aligned`.
    vertices: np.ndarray
    #: (F, 3) m, `cam_aligned`.
    camera: np.ndarray
    #: (F, 21, 2) px of the whole frame.
    landmarks: np.ndarray
    #: (F,) bool, false where a value is not finite.
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class OfficialRecords:
    """All records of one capture of the release."""

    #: (F,) the first integer in each image's name, ascending.
    numbers: np.ndarray
    #: F image files.
    images: tuple[Path, ...]
    #: F mask files.
    masks: tuple[Path, ...]
    #: (F,) px of the whole frame.
    focal: np.ndarray
    #: F boxes (4,) x1, y1, x2, y2 as stored, or None where there is none.
    boxes: tuple[np.ndarray | None, ...]
    #: (F, 3) m.
    root_rel: np.ndarray
    #: The tracked hands.
    sides: Mapping[str, SideRecords]
    #: Keys that the format does not list.
    unknown: tuple[str, ...]
    #: Whether the records were not in the order of their numbers.
    reordered: bool


def read_records(folder: OfficialFolder) -> OfficialRecords:
    """Read and check the pickles of one capture."""
    rows: list[tuple[int, dict[str, Any], Path]] = []
    for pickle in folder.pickles:
        content = load_pickle(pickle, max_bytes=MAX_PICKLE_BYTES)
        if not isinstance(content, list) or not content:
            raise BadInput("is not a list of frame records", where=pickle)
        rows += [(_number(row, i, pickle), row, pickle) for i, row in enumerate(content)]
    if len(rows) > MAX_FRAMES:
        raise BadInput(f"holds {len(rows)} frames, more than {MAX_FRAMES}", where=folder.path)
    numbers = [number for number, _, _ in rows]
    rows.sort(key=lambda row: row[0])
    for before, after in itertools.pairwise(rows):
        if before[0] == after[0]:
            raise BadInput(
                f"two records have the number {after[0]}", where=after[2], field="img_path"
            )
    sides = [
        side for side in ("right", "left") if any(f"mano_pose_{side}" in r for _, r, _ in rows)
    ]
    if not sides:
        raise BadInput("is missing", where=folder.pickles[0], field="record 0: mano_pose_right")
    known = {*FRAME_KEYS, *(f"{key}_{side}" for key in SIDE_KEYS for side in ("right", "left"))}
    return OfficialRecords(
        numbers=np.array([number for number, _, _ in rows]),
        images=tuple(_file(row, "img_path", pickle) for _, row, pickle in rows),
        masks=tuple(_file(row, "mask_sam1_path", pickle) for _, row, pickle in rows),
        focal=_focal(rows),
        boxes=tuple(_box(row, pickle, number) for number, row, pickle in rows),
        root_rel=_stack(rows, "root_rel", (3,), optional="left" not in sides),
        sides={side: _side(rows, side) for side in sides},
        unknown=tuple(sorted({str(key) for _, row, _ in rows for key in row} - known)),
        reordered=numbers != sorted(numbers),
    )


Rows = Sequence[tuple[int, dict[str, Any], Path]]


def _number(row: Any, index: int, pickle: Path) -> int:
    if not isinstance(row, dict):
        raise BadInput(f"record {index} is not a dict", where=pickle)
    field = f"record {index}: img_path"
    path = row.get("img_path")
    if not isinstance(path, str):
        problem = "is missing" if path is None else f"is a {type(path).__name__}, not a string"
        raise BadInput(problem, where=pickle, field=field)
    found = re.search(r"\d{1,15}", re.split(r"[\\/]", path)[-1])
    if found is None:
        raise BadInput(f"{path[-80:]!r} has no number", where=pickle, field=field)
    return int(found.group())


def _file(row: Mapping[str, Any], key: str, pickle: Path) -> Path:
    named = row.get(key)
    if key not in row:
        # The release names a mask after its image.
        stem, dot, ending = row["img_path"].rpartition(".")
        named = f"{stem}_sam1_mask{dot}{ending}"
    if not isinstance(named, str):
        raise BadInput(f"is a {type(named).__name__}, not a string", where=pickle, field=key)
    return find_file(pickle.parent, named, where=pickle, field=key)


def _box(row: Mapping[str, Any], pickle: Path, number: int) -> np.ndarray | None:
    if "bbox_inter" not in row:
        return None
    box = _array(row, "bbox_inter", pickle, number)
    finite = box.shape == (4,) and np.isfinite(box).all()
    if not finite or not (box[2] > box[0] and box[3] > box[1]) or np.abs(box).max() > 1e6:
        said = f"frame {number}: is not a box x1, y1, x2, y2"
        raise BadInput(said, where=pickle, field="bbox_inter")
    return box


def _side(rows: Rows, side: str) -> SideRecords:
    arrays = {key: _stack(rows, f"{key}_{side}", shape) for key, shape in SIDE_KEYS.items()}
    flat = [array.reshape(len(rows), -1) for array in arrays.values()]
    if side == "left":
        # The tracker places the left hand by it.
        flat.append(_stack(rows, "root_rel", (3,)))
    return SideRecords(
        pose=arrays["mano_pose"].reshape(-1, 16, 3),
        shape=arrays["mano_shape"],
        vertices=arrays["verts3d_world"] + arrays["cam_aligned"][:, None],
        camera=arrays["cam_aligned"],
        landmarks=arrays["joints2d_world"],
        valid=np.isfinite(np.concatenate(flat, axis=1)).all(axis=1),
    )


def _stack(rows: Rows, key: str, shape: tuple[int, ...], *, optional: bool = False) -> np.ndarray:
    stacked = np.zeros((len(rows), *shape))
    for index, (number, row, pickle) in enumerate(rows):
        if optional and key not in row:
            continue
        value = _array(row, key, pickle, number)
        if value.shape not in ((1, *shape), shape) and (shape or value.size != 1):
            said = f"frame {number}: has shape {value.shape} where {(1, *shape)} is expected"
            raise BadInput(said, where=pickle, field=key)
        stacked[index] = value.reshape(shape)
    return stacked


def _focal(rows: Rows) -> np.ndarray:
    focal = _stack(rows, "scaled_focal_length", ())
    for value, (number, _, pickle) in zip(focal, rows, strict=True):
        if not 0 < value < 1e7:
            said = f"frame {number}: is not a focal length in pixels"
            raise BadInput(said, where=pickle, field="scaled_focal_length")
    return focal


def _array(row: Mapping[str, Any], key: str, pickle: Path, number: int) -> np.ndarray:
    value, problem = row.get(key), ""
    if key not in row:
        problem = "is missing"
    elif isinstance(value, bool) or not isinstance(value, int | float | np.ndarray | np.generic):
        problem = f"is a {type(value).__name__}, not an array"
    elif np.asarray(value).dtype.kind not in "fiu":
        problem = f"holds {np.asarray(value).dtype}"
    if problem:
        raise BadInput(f"frame {number}: {problem}", where=pickle, field=key)
    return np.asarray(value)
