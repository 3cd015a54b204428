"""nerfstudio's `transforms.json`: a capture written as one, and one read as a capture.

A frame has `transform_matrix`, camera to world, with OpenGL axes of the camera (x right, y up, z
backwards), and `fl_x`, `fl_y`, `cx`, `cy` in px, of its own or at the top of the file. Pixel
centres lie at +0.5 in both formats. `applied_transform` (3, 4) and then `applied_scale` lead from
the world of the data to the world of the file. nerfstudio has z up there; a capture that was
filmed upright has y down.

What nerfstudio has no place for stands beside it: the hands in `hands.npz`, as a capture has them,
in metres of the world of the data; and the other facts of a capture under the key `hwp`.

Source: nerfstudio, `nerfstudio/data/dataparsers/nerfstudio_dataparser.py` and
`docs/quickstart/data_conventions.md`.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.arrays import read_npz, write_npz
from hwp_bench.base.errors import BadInput, HwpError, place
from hwp_bench.base.files import atomic_folder, inside, read_json, refuse_existing, write_json
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.capture import Cameras, Capture, CaptureInfo, CaptureWriter, identify_hand_model
from hwp_bench.capture.folder import open_capture
from hwp_bench.capture.schema import (
    HANDS,
    LARGEST,
    MAX_FRAMES,
    SCHEMA,
    SIDES,
    frame_name,
    hand_arrays,
    image_path,
    read_hands,
)
from hwp_bench.capture.splits import MIN_FRAMES, contiguous_split

#: Name of the file.
TRANSFORMS = "transforms.json"
# Camera axes of OpenCV to those of OpenGL, and back.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# From a world with y down to one with z up.
_UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
# Facts of a capture that follow from its images, or are not true of a copy.
_FOUND_ANEW = ("digests", "source", "width", "height", "frame_count")


def export_transforms(
    capture: Capture | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
) -> Path:
    """Write a capture as a folder that nerfstudio's default data parser reads.

    It holds `transforms.json`, the frames in `images/`, the masks in `masks/` and `hands.npz`.
    The lists `train_filenames`, `val_filenames` and `test_filenames` are the split by the 80/10/10
    rule, where the capture has frames enough. Truth and free-view clip are left out.

    Returns:
        The path of `transforms.json`.

    Raises:
        UsageError: `out` exists.
        BadInput: a camera has skew, which `transforms.json` cannot express.
    """
    out = place(out, "out")
    capture = capture if isinstance(capture, Capture) else open_capture(capture)
    info, cameras = capture.info, capture.cameras
    if cameras.Ks[:, 0, 1].any():
        raise BadInput("has skew, for which transforms.json has no field", where=capture.root)
    poses = _UPRIGHT @ np.linalg.inv(cameras.viewmats) @ _FLIP
    names = [f"images/{frame_name(frame)}" for frame in range(len(capture))]
    content: dict[str, Any] = {
        "camera_model": "OPENCV",
        "w": info.width,
        "h": info.height,
        "applied_transform": _UPRIGHT[:3].tolist(),
        "hwp": {name: v for name, v in info.to_json().items() if name not in _FOUND_ANEW},
    }
    if len(capture) >= MIN_FRAMES:
        split = contiguous_split(info.id, len(capture))
        for part, frames in (
            ("train", split.train),
            ("val", split.validation),
            ("test", split.test),
        ):
            content[f"{part}_filenames"] = [names[frame] for frame in frames]
    content["frames"] = [
        {
            "file_path": name,
            "mask_path": f"masks/{Path(name).name}",
            **{"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
            "transform_matrix": pose.tolist(),
        }
        for name, K, pose in zip(names, cameras.Ks, poses, strict=True)
    ]
    with atomic_folder(out, overwrite=overwrite, flag="--force") as root:
        for kind, folder in (("frames", "images"), ("masks", "masks")):
            (root / folder).mkdir()
            for frame in range(len(capture)):
                capture.image(kind, frame)  # a damaged one is named here
                source = image_path(capture.root, kind, frame)
                shutil.copyfile(source, root / folder / source.name)
        write_npz(root / HANDS, hand_arrays(capture.hands))
        write_json(root / TRANSFORMS, content)
    return out / TRANSFORMS


def import_transforms(
    source: str | os.PathLike[str], out: str | os.PathLike[str], *, overwrite: bool = False
) -> Capture:
    """Make a capture of a folder with `transforms.json`, masks and `hands.npz`.

    `applied_transform` and `applied_scale` are undone, so that the cameras are in the world of the
    hands, in metres. The frames keep the order of the file, and are rows of the arrays.

    Args:
        source: the folder, or its `transforms.json`.
        out: the capture folder to make.

    Raises:
        BadInput: a field is missing or wrong, a lens is distorted, a frame has no mask, or there
            are no hands.
        UsageError: `out` exists.
    """
    file, out = place(source, "source"), place(out, "out")
    refuse_existing(out, overwrite=overwrite, flag="--force")
    file = file / TRANSFORMS if file.is_dir() else file
    content = read_json(file)
    frames = content.get("frames") if isinstance(content, Mapping) else None
    if not isinstance(frames, list) or not 0 < len(frames) <= MAX_FRAMES:
        raise BadInput(f"is not a list of 1 to {MAX_FRAMES} frames", where=file, field="frames")
    merged = []
    for number, frame in enumerate(frames):
        if not isinstance(frame, Mapping):
            raise BadInput("is not a table", where=file, field=f"frames[{number}]")
        merged.append({**content, **frame})
    for one in merged:
        _check_lens(one, file)
    sizes = {tuple(int(_numbers(one.get(e), (), e, file)) for e in ("w", "h")) for one in merged}
    cameras = _read_cameras(content, merged, file)
    info, sides = _read_info(content, file, sizes, len(frames))
    hands = read_hands(file.parent / HANDS, sides, len(frames))
    size = (info.height, info.width)
    with CaptureWriter(out, info, hands, cameras, overwrite=overwrite) as writer:
        for number, one in enumerate(merged):
            writer.frame(number, read_rgb(_file(one, "file_path", number, file), size))
            writer.mask(number, read_gray(_file(one, "mask_path", number, file), size))
    return open_capture(out)


def _check_lens(frame: Mapping[str, Any], file: Path) -> None:
    """Refuse a camera that is not a pinhole."""
    if frame.get("camera_model", "OPENCV") not in _PINHOLES or any(map(frame.get, _DISTORTION)):
        raise BadInput(
            "the lens is distorted, and a capture has pinhole cameras",
            where=file,
            field="camera_model",
            remedy="Undistort the images first, and write k1 to k4, p1 and p2 as 0.",
        )


def _read_cameras(content: Mapping[str, Any], frames: list[dict[str, Any]], file: Path) -> Cameras:
    """The cameras in the world of the data, with OpenCV axes."""
    applied, Ks, poses = np.eye(4), np.zeros((len(frames), 3, 3)), []
    if "applied_transform" in content:
        applied = _matrix(content["applied_transform"], "applied_transform", file)
    scale = _numbers(content.get("applied_scale", 1.0), (), "applied_scale", file)
    if scale <= 0.0:
        raise BadInput("is not above 0", where=file, field="applied_scale")
    for number, frame in enumerate(frames):
        for name, (row, column) in (
            *(("fl_x", (0, 0)), ("fl_y", (1, 1))),
            *(("cx", (0, 2)), ("cy", (1, 2))),
        ):
            field = f"frames[{number}].{name}"
            Ks[number, row, column] = _numbers(frame.get(name), (), field, file)
        Ks[number, 2, 2] = 1.0
        field = f"frames[{number}].transform_matrix"
        poses.append(_matrix(frame.get("transform_matrix"), field, file))
    stacked = np.stack(poses)
    stacked[:, :3, 3] /= scale
    try:
        viewmats = np.linalg.inv(np.linalg.inv(applied) @ stacked @ _FLIP)
        return Cameras(Ks, viewmats)
    except (np.linalg.LinAlgError, HwpError) as error:
        raise BadInput(f"a camera is no rigid pinhole ({error})", where=file) from error


def _read_info(
    content: Mapping[str, Any], file: Path, sizes: set[tuple[int, ...]], count: int
) -> tuple[CaptureInfo, tuple[str, ...]]:
    """Everything else about the capture, and the sides of its hands."""
    if len(sizes) != 1:
        raise BadInput("is not one size for all frames", where=file, field="w, h")
    if not (file.parent / HANDS).is_file():
        raise BadInput(
            "is missing: a capture has the pose of its hands",
            where=file.parent / HANDS,
            remedy="Write right_pose (F, 16, 3) rad, right_betas (10,), right_transl (F, 3) m and "
            "right_valid (F,) bool there, or those of left; docs/capture.md describes them.",
        )
    arrays = read_npz(file.parent / HANDS)
    sides = tuple(side for side in SIDES["both"] if f"{side}_pose" in arrays)
    shown = "both" if len(sides) == 2 else "".join(sides) or "right"
    unknown = dict.fromkeys(("action", "device", "licence"), "unknown")
    given = content.get("hwp")
    facts: dict[str, Any] = {
        **unknown,
        **{"schema": SCHEMA, "id": file.absolute().parent.name, "fps": 30.0, "perturbations": {}},
        "hand_model": None,
        **(given if isinstance(given, Mapping) else {}),
        "hands": shown,
        **dict(zip(("width", "height"), next(iter(sizes)), strict=True)),
        "frame_count": count,
        "source": {"kind": "transforms", "importer": {"name": "transforms", "version": 1}},
        "digests": {},
    }
    if facts["hand_model"] is None:
        facts["hand_model"] = dict(vars(identify_hand_model("anny", shown)))
    return CaptureInfo.from_json(facts, where=os.fspath(file)), SIDES[shown]


def _numbers(value: Any, shape: tuple[int, ...], field: str, file: Path) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not (np.abs(array) <= LARGEST).all():
        kind = f"a matrix {shape}" if shape else "a number"
        raise BadInput(f"is not {kind} up to {LARGEST:g}", where=file, field=field)
    return array


def _matrix(value: Any, field: str, file: Path) -> np.ndarray:
    """(4, 4), from rows of which the last may be missing."""
    if isinstance(value, list) and len(value) == 3:
        value = [*value, [0.0, 0.0, 0.0, 1.0]]
    return _numbers(value, (4, 4), field, file)


def _file(frame: Mapping[str, Any], name: str, number: int, file: Path) -> Path:
    value = frame.get(name)
    if not isinstance(value, str):
        raise BadInput(
            "is missing: a capture has a frame and a mask of the hand for each moment",
            where=file,
            field=f"frames[{number}].{name}",
        )
    return inside(file.parent, value)
