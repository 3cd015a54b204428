"""The arrays of a capture: cameras and hand parameters of every frame, read and written."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.arrays import read_npz, take, write_npz
from hwp_bench.base.errors import BadInput
from hwp_bench.hands.parameters import Camera, HandParameters

#: Largest number of a capture's hands and cameras: rad, m, px. Squares of it are exact enough in
#: float32, and what is drawn with it has a place.
LARGEST = 1e6


@dataclass(frozen=True)
class Cameras:
    """One pinhole camera a frame, OpenCV axes (x right, y down, z forward).

    Raises:
        BadInput: shapes differ, a value is not finite or beyond `LARGEST`, a focal length is not
            positive, or a view matrix is not a rigid motion.
    """

    #: (F, 3, 3) intrinsics in pixels; pixel centres lie at +0.5.
    Ks: np.ndarray
    #: (F, 4, 4) world to camera, metres.
    viewmats: np.ndarray

    def __post_init__(self) -> None:
        check_cameras(self.Ks, self.viewmats, where="cameras")

    def __len__(self) -> int:
        return len(self.Ks)

    def camera(self, frame: int, width: int, height: int) -> Camera:
        """Return the camera of one frame, for images of a size in px."""
        return Camera(self.Ks[frame], self.viewmats[frame], width, height)


def check_cameras(Ks: np.ndarray, viewmats: np.ndarray, *, where: str) -> None:
    """Refuse cameras that cannot project.

    Args:
        Ks: (F, 3, 3) intrinsics, px.
        viewmats: (F, 4, 4) world to camera.
        where: the file, for the message.

    Raises:
        BadInput: what `Cameras` lists; the frame is named.
    """
    arrays = {"Ks": np.asarray(Ks), "viewmats": np.asarray(viewmats)}
    count = len(arrays["Ks"])
    K = take(arrays, "Ks", (count, 3, 3), where=where, most=LARGEST)
    V = take(arrays, "viewmats", (count, 4, 4), where=where, most=LARGEST)
    rotation = V[:, :3, :3]
    rules = (
        ("Ks", (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0), "a focal length that is not above 0"),
        (
            "Ks",
            (np.abs(K[:, 2] - (0, 0, 1)) < 1e-9).all(axis=1) & (K[:, 1, 0] == 0),
            "a matrix that is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]]",
        ),
        (
            "viewmats",
            (np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)) < 1e-4).all(axis=(1, 2))
            & (np.linalg.det(rotation) > 0),
            "a rotation that is not orthonormal",
        ),
        (
            "viewmats",
            (np.abs(V[:, 3] - (0, 0, 0, 1)) < 1e-9).all(axis=1),
            "a last row that is not (0, 0, 0, 1)",
        ),
    )
    for field, good, problem in rules:
        if not good.all():
            raise BadInput(f"frame {int(np.argmin(good))} has {problem}", where=where, field=field)


def read_cameras(path: str | os.PathLike[str], frame_count: int) -> Cameras:
    """Read `cameras.npz`.

    Raises:
        BadInput: missing, damaged, or not `frame_count` sound cameras.
    """
    arrays = read_npz(path)
    Ks = take(arrays, "Ks", (frame_count, 3, 3), where=path)
    viewmats = take(arrays, "viewmats", (frame_count, 4, 4), where=path)
    check_cameras(Ks, viewmats, where=os.fspath(path))
    return Cameras(Ks, viewmats)


def write_cameras(path: str | os.PathLike[str], cameras: Cameras) -> None:
    """Write `cameras.npz`."""
    write_npz(path, {"Ks": cameras.Ks, "viewmats": cameras.viewmats})


def read_hands(
    path: str | os.PathLike[str], sides: tuple[str, ...], frame_count: int
) -> dict[str, HandParameters]:
    """Read `hands.npz`: for each side `{side}_pose`, `_betas`, `_transl`, `_valid`.

    Returns:
        Parameters by side, in the order of `sides`.

    Raises:
        BadInput: missing, damaged, of another length, not finite or beyond `LARGEST`; the array is
            named.
    """
    arrays = read_npz(path)
    return {
        side: HandParameters(
            pose=take(arrays, f"{side}_pose", (frame_count, 16, 3), where=path, most=LARGEST),
            betas=take(arrays, f"{side}_betas", (10,), where=path, most=LARGEST),
            transl=take(arrays, f"{side}_transl", (frame_count, 3), where=path, most=LARGEST),
            valid=take(arrays, f"{side}_valid", (frame_count,), where=path, dtype=bool),
        )
        for side in sides
    }


def write_hands(path: str | os.PathLike[str], hands: Mapping[str, HandParameters]) -> None:
    """Write `hands.npz`."""
    write_npz(path, hand_arrays(hands))


def hand_arrays(hands: Mapping[str, HandParameters]) -> dict[str, np.ndarray]:
    """Return the named arrays that `hands.npz` holds."""
    return {
        f"{side}_{name}": np.asarray(getattr(parameters, name))
        for side, parameters in hands.items()
        for name in ("pose", "betas", "transl", "valid")
    }


def arrays_digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 (hex) of named arrays: names, shapes, types and values."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name}{array.shape}{array.dtype.str}".encode())
        total.update(array.tobytes())
    return total.hexdigest()
