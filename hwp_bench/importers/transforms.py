"""nerfstudio's `transforms.json`: a capture written as one, and one read as a capture.

A frame has `transform_matrix`, camera to world, with OpenGL axes of the camera (x right, y up, z
backwards), and `fl_x`, `fl_y`, `cx`, `cy` in px, of its own or at the top of the file. Pixel
centres lie at +0.5 in both formats. `applied_transform` (3, 4) and then `applied_scale` lead from
the world of the data to that of the file, where z is up; a capture filmed upright has y down.

The hands are next to it in `hands.npz`, as a capture has them, in the world of the data (m). The
other facts of a capture are under the key `hwp`.

Source: nerfstudio, `nerfstudio/data/dataparsers/nerfstudio_dataparser.py`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from hwp_bench.base.arrays import read_npz, write_npz
from hwp_bench.base.errors import BadInput, of_type, place
from hwp_bench.base.files import (
    atomic_folder,
    check_places,
    inside,
    read_json,
    refuse_existing,
    refuse_other,
    write_json,
)
from hwp_bench.base.images import read_gray, read_rgb, write_image
from hwp_bench.base.records import Line, parse_record
from hwp_bench.capture import Cameras, Capture, CaptureInfo, CaptureWriter, schema
from hwp_bench.capture.folder import identify_hand_model, open_capture
from hwp_bench.capture.splits import MIN_FRAMES, contiguous_split

#: Name of the file.
TRANSFORMS = "transforms.json"
_SOURCE = {"kind": "transforms", "importer": {"name": "transforms", "version": 1}}
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
# Camera axes of OpenCV to those of OpenGL, and back; a world with y down to one with z up.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

_Number = Annotated[float, Meta(ge=-schema.LARGEST, le=schema.LARGEST)]
_Rows = Annotated[
    Sequence[tuple[_Number, _Number, _Number, _Number]], Meta(min_length=3, max_length=4)
]


@dataclass(frozen=True)
class _Frame:
    """A frame, with the fields that the file states for all frames."""

    file_path: Line
    mask_path: Line
    transform_matrix: _Rows
    w: _Number
    h: _Number
    fl_x: _Number
    fl_y: _Number
    cx: _Number
    cy: _Number
    applied_transform: _Rows = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    applied_scale: Annotated[float, Meta(gt=0.0, le=schema.LARGEST)] = 1.0

    def viewmat(self) -> np.ndarray:
        """(4, 4), from the world of the data to the camera, OpenCV axes."""
        pose, applied = np.eye(4), np.eye(4)
        pose[:3], applied[:3] = self.transform_matrix[:3], self.applied_transform[:3]
        pose[:3, 3] /= self.applied_scale
        return np.linalg.inv(np.linalg.inv(applied) @ pose @ _FLIP)


@dataclass(frozen=True)
class _File:
    frames: Annotated[list[_Frame], Meta(min_length=1, max_length=schema.MAX_FRAMES)]


def export_transforms(
    capture: Capture, out: str | os.PathLike[str], *, overwrite: bool = False
) -> Path:
    """Write a capture as a folder that nerfstudio's default data parser reads.

    It returns the path of `transforms.json`, next to `images/`, `masks/` and `hands.npz`. The file
    lists the split by the 80/10/10 rule. Truth and free-view clip are left out.

    Raises:
        UsageError: `out` exists without `overwrite`, is something else than an exported scene, lies
            in a capture or holds this one.
        BadInput: a camera has skew, which `transforms.json` cannot express.
    """
    of_type(capture, Capture, "capture", "an opened capture")
    out, info, cameras = place(out, "out"), capture.info, capture.cameras
    check_places({"out": out}, {"capture": capture.root}, replaces=overwrite)
    refuse_other(out, "an exported scene", lambda folder: (folder / TRANSFORMS).is_file())
    if cameras.Ks[:, 0, 1].any():
        raise BadInput("has skew, for which transforms.json has no field", where=capture.root)
    poses = _UPRIGHT @ np.linalg.inv(cameras.viewmats) @ _FLIP
    names = [schema.frame_name(frame) for frame in range(len(capture))]
    content: dict[str, Any] = {
        **{"camera_model": "OPENCV", "w": info.width, "h": info.height},
        "applied_transform": _UPRIGHT[:3].tolist(),
        "hwp": {**info.to_json(), "source": {}, "digests": {}},
    }
    if len(names) >= MIN_FRAMES:
        split = contiguous_split(info.id, len(names))
        parts = {"train": split.train, "val": split.validation, "test": split.test}
        for part, frames in parts.items():
            content[f"{part}_filenames"] = [f"images/{names[frame]}" for frame in frames]
    content["frames"] = [
        {
            **{"file_path": f"images/{name}", "mask_path": f"masks/{name}"},
            **{"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
            "transform_matrix": pose.tolist(),
        }
        for name, K, pose in zip(names, cameras.Ks, poses, strict=True)
    ]
    with atomic_folder(out, overwrite=overwrite) as root:
        for frame, name in enumerate(names):
            write_image(root / "images" / name, capture.frame(frame))
            write_image(root / "masks" / name, capture.mask(frame))
        write_npz(root / schema.HANDS, schema.hand_arrays(capture.hands))
        write_json(root / TRANSFORMS, content)
    return out / TRANSFORMS


def import_transforms(
    source: str | os.PathLike[str], out: str | os.PathLike[str], *, overwrite: bool = False
) -> Capture:
    """Make a capture of a folder, or its `transforms.json`, with masks and `hands.npz`.

    `applied_transform` and `applied_scale` are undone, so that the cameras are in the world of the
    hands, in metres. The frames keep the order of the file, as do the rows of `hands.npz`.

    Raises:
        BadInput: a field is missing or wrong, a lens is distorted, or there is no mask or hand.
        UsageError: `out` exists.
    """
    file, out = place(source, "source"), place(out, "out")
    refuse_existing(out, overwrite=overwrite)
    file = file / TRANSFORMS if file.is_dir() else file
    top = read_json(file)
    top = top if isinstance(top, dict) else {}
    listed = top.pop("frames", None)
    if isinstance(listed, list):
        listed = [{**top, **one} if isinstance(one, dict) else one for one in listed]
    options: dict[str, Any] = {"where": file, "error": BadInput, "ignore_unknown": True}
    frames = parse_record(_File, {"frames": listed}, **options).frames
    for one in listed:
        if any(map(one.get, _DISTORTION)) or one.get("camera_model", "OPENCV") not in _PINHOLES:
            remedy = "Undistort the images first: a capture has pinhole cameras."
            raise BadInput("the lens is distorted", where=file, field="camera_model", remedy=remedy)
    size, hands_file = (int(frames[0].h), int(frames[0].w)), file.parent / schema.HANDS
    if not hands_file.is_file():
        remedy = "Write the pose of the hands there, as docs/data.md says."
        raise BadInput("is missing", where=hands_file, remedy=remedy)
    arrays = read_npz(hands_file)
    sides = tuple(side for side in schema.SIDES["both"] if f"{side}_pose" in arrays)
    shown = next((name for name in schema.SIDES if schema.SIDES[name] == sides), "right")
    facts: dict[str, Any] = dict.fromkeys(("action", "device", "licence"), "unknown")
    facts |= {"id": file.absolute().parent.name, "fps": 30.0, "perturbations": {}}
    facts["hand_model"] = dict(vars(identify_hand_model("anny", shown)))
    facts |= top["hwp"] if isinstance(top.get("hwp"), dict) else {}
    facts |= {"schema": schema.SCHEMA, "hands": shown, "frame_count": len(frames), "digests": {}}
    facts |= {"source": _SOURCE, "height": size[0], "width": size[1]}
    info = CaptureInfo.from_json(facts, where=os.fspath(file))
    Ks = [[[one.fl_x, 0.0, one.cx], [0.0, one.fl_y, one.cy], [0.0, 0.0, 1.0]] for one in frames]
    try:
        cameras = Cameras(np.array(Ks), np.stack([one.viewmat() for one in frames]))
    except (np.linalg.LinAlgError, BadInput) as error:
        raise BadInput(f"a camera is not a rigid pinhole ({error})", where=file) from error
    hands = schema.read_hands(hands_file, info.sides, len(frames))
    with CaptureWriter(out, info, hands, cameras, overwrite=overwrite) as writer:
        for number, one in enumerate(frames):
            writer.frame(number, read_rgb(inside(file.parent, one.file_path), size))
            writer.mask(number, read_gray(inside(file.parent, one.mask_path), size))
    return open_capture(out)
