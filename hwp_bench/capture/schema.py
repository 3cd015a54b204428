"""A capture folder: where its files lie, `capture.json`, and its arrays, checked field by field."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from hwp_bench.base.arrays import read_npz, take, write_npz
from hwp_bench.base.errors import BadCapture, BadInput
from hwp_bench.base.files import sha256_json
from hwp_bench.base.records import Text, parse_record, without_schema
from hwp_bench.hands.skeleton import JOINT_COUNT, Camera, HandParameters
from hwp_bench.hands.template import HandTemplate, rebuilt
from hwp_bench.taxonomy import check_severity, perturbation

#: Version of the capture format; a reader refuses every other.
SCHEMA = "hwp-capture/1"
#: The file that describes the capture.
METADATA = "capture.json"
#: Estimated hand parameters, as a method is given them.
HANDS = "hands.npz"
#: Intrinsics and view matrices.
CAMERAS = "cameras.npz"
#: True hand parameters, where they are known; withheld from methods.
TRUE_HANDS = "truth/hands.npz"
#: The subject's own hands at rest, where they are known and have the hand model's triangles;
#: withheld from methods, and in no digest, since it follows from the scene.
TRUE_TEMPLATE = "truth/template.npz"
#: Further files of the maker (scene, timings, overlays); withheld from methods.
EXTRA = "extra"
#: Folder of the free-view clip, a small capture of its own; withheld but for hands and cameras.
FREE_VIEW = "free"
#: `source.kind` of a capture that was simulated: it declares everything that perturbs it.
SIMULATED = "simulated"

#: Folder of each kind of image. All but `frames` and `masks` are truth, withheld from methods.
IMAGE_FOLDERS = {
    "frames": "frames",
    "masks": "masks",
    "clean": "truth/clean",
    "true_masks": "truth/masks",
    "clean_masks": "truth/clean_masks",
}
#: Kinds of images that are coloured; the others are coverage.
RGB_KINDS = ("frames", "clean")
#: Most frames that a capture may claim.
MAX_FRAMES = 100_000
#: Largest edge of a frame, in pixels.
MAX_EDGE = 8192
#: Rate of a capture's frames: from one in 1,000 seconds to the fastest cameras.
FrameRate = Annotated[float, Meta(ge=1e-3, le=1e6)]
#: The hands that a capture may hold, and the sides that it then has parameters for.
SIDES: Mapping[str, tuple[str, ...]] = {
    "right": ("right",),
    "left": ("left",),
    "both": ("right", "left"),
}
#: Longest id of a capture.
MAX_ID = 100
_ID = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_ID - 1}}}")
_Edge = Annotated[int, Meta(ge=1, le=MAX_EDGE)]


@dataclass(frozen=True)
class HandModelId:
    """The hand model to which the parameters of a capture belong."""

    #: Name of the template, such as `anny-1` or `mano`.
    name: Text
    #: Digest of the template, hex.
    digest: Text
    #: What `load_template` takes to find it, such as `anny` or `mano:PATH`.
    source: Text = "anny"


@dataclass(frozen=True)
class CaptureInfo:
    """Everything about a capture except its pixels and numbers."""

    #: Name, unique within a benchmark: letters, digits, `.`, `_`, `-`.
    id: Text
    #: `right`, `left` or `both`.
    hands: str = field(metadata={"choices": tuple(SIDES)})
    #: Action of the hands.
    action: Text
    #: Device that recorded it.
    device: Text
    #: Frames per second; their mean where `times` are given.
    fps: FrameRate
    #: Width of every frame, in pixels.
    width: _Edge
    #: Height of every frame, in pixels.
    height: _Edge
    #: Number of frames F.
    frame_count: Annotated[int, Meta(ge=1, le=MAX_FRAMES)]
    #: The hand model that `pose`, `betas` and `transl` belong to.
    hand_model: HandModelId
    #: Declared perturbations: severity 0-5 of every frame, or None where it is not known.
    perturbations: Mapping[str, tuple[int, ...] | None]
    #: Where the capture comes from: any JSON object.
    source: Mapping[str, Any]
    #: Terms under which the frames may be used.
    licence: Text
    #: SHA-256 of the content by part (`frames`, `masks`, `hands`, ...); empty before writing.
    digests: Mapping[str, str] | None = None
    #: When each frame was recorded, s from the first, rising; None where all steps are equal.
    times: tuple[float, ...] | None = None

    def frame_times(self) -> np.ndarray:
        """Return when each frame was recorded, (F,) s from the first."""
        if self.times is None:
            return np.arange(self.frame_count) / self.fps
        return np.array(self.times)

    @property
    def sides(self) -> tuple[str, ...]:
        """The hands that have parameters: `right`, `left` or both."""
        return SIDES[self.hands]

    @property
    def interacting(self) -> bool:
        """Whether two hands are in the image (the paper's `interacting`)."""
        return self.hands == "both"

    @property
    def made_by(self) -> str | None:
        """Importer and version that made the hand parameters and masks, such as `video 1`.

        It is `source.importer`, an object of `name` and `version`. None where the capture does not
        say so: simulated ones, and imports that are older than this record.
        """
        maker = self.source.get("importer")
        if not isinstance(maker, Mapping):
            return None
        name, version = maker.get("name"), maker.get("version")
        return f"{name} {version}" if isinstance(name, str) and isinstance(version, int) else None

    @property
    def origin(self) -> str | None:
        """Digest (hex) of what an imported video's capture was made from; None for others.

        Two machines may round an import otherwise, and the digests of its captures then differ:
        with one origin they differ in nothing else.
        """
        video, frames = self.source.get("video"), self.source.get("frames")
        if not isinstance(video, Mapping) or not isinstance(frames, list) or not self.made_by:
            return None
        return import_origin(video.get("sha256"), self.made_by, frames, self.width, self.hands)

    def severity(self, frame: int) -> dict[str, int | None]:
        """Return the severity of every declared perturbation in one frame."""
        return {
            name: None if values is None else values[frame]
            for name, values in self.perturbations.items()
        }

    def rank_with_severity(self, frames: Sequence[int], weights: Sequence[float]) -> float | None:
        """Return Spearman's correlation of weights with the severity of their frames.

        Severity is the sum of the levels of all perturbations of a frame. None where there is no
        such frame, a level is not known, or all frames have the same severity or weight.
        """
        if max(frames, default=0) >= self.frame_count:
            return None
        levels = [[*self.severity(frame).values()] for frame in frames]
        if any(level is None for each in levels for level in each):
            return None
        severity = [sum(level or 0 for level in each) for each in levels]
        if len(set(severity)) < 2 or len(set(weights)) < 2:
            return None
        # Imported here: it takes half a second, which every command and fit would wait for.
        from scipy.stats import spearmanr

        return float(spearmanr(weights, severity).statistic)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that `from_json` reads."""
        # Captures of an even rate stay as versions without times wrote them.
        written = {k: v for k, v in vars(self).items() if k != "times" or v is not None}
        return {
            "schema": SCHEMA,
            **written,
            "fps": float(self.fps),
            "hand_model": dict(vars(self.hand_model)),
            "perturbations": {
                name: None if values is None else list(values)
                for name, values in self.perturbations.items()
            },
            "source": dict(self.source),
            "digests": dict(self.digests or {}),
        }

    @classmethod
    def from_json(cls, value: Any, *, where: str) -> CaptureInfo:
        """Check a JSON object and make a `CaptureInfo` of it.

        Raises:
            BadCapture: a field is missing, of the wrong type or out of range; it is named.
        """
        content = without_schema(
            value,
            SCHEMA,
            where=where,
            error=BadCapture,
            remedy="Write the capture again with this version of the toolkit.",
        )
        # Readers of this version have always skipped unknown fields.
        content = {"times": None, **content}
        info = parse_record(
            cls, content, where=where, error=BadCapture, complete=True, ignore_unknown=True
        )
        for name, values in info.perturbations.items():
            place = f"perturbations.{name}"
            perturbation(name, where=where, field="perturbations")
            if values is None:
                continue
            if len(values) != info.frame_count:
                said = f"must be null or a list of {info.frame_count} severities"
                raise BadCapture(said, where=where, field=place)
            check_severity(values, where=where, field=place)
        if info.times is not None:
            steps = np.diff(info.times)
            if len(info.times) != info.frame_count or info.times[0] != 0 or (steps <= 0).any():
                said = f"must be null or {info.frame_count} rising seconds, the first 0"
                raise BadCapture(said, where=where, field="times")
        check_id(info.id, where)
        return info


def import_origin(
    sha256: object, made_by: str, frames: Iterable[object], size: int, hands: str
) -> str:
    """Return the digest of a video, its importer, the frames and what was asked for."""
    return sha256_json([sha256, made_by, list(frames), size, hands])


def check_id(identifier: str, where: str) -> None:
    """Refuse a capture id that could not be a folder's name everywhere."""
    if not _ID.fullmatch(identifier):
        raise BadCapture(
            f"{identifier!r} is not a capture id",
            where=where,
            field="id",
            remedy="Use up to 100 letters, digits, dots, underscores and hyphens.",
        )


def image_path(root: Path, kind: str, frame: int) -> Path:
    """Return the file of one image: `kind` is a key of `IMAGE_FOLDERS`."""
    return root / IMAGE_FOLDERS[kind] / frame_name(frame)


def frame_name(frame: int) -> str:
    """Return the file name of a frame, as captures and predictions use it."""
    return f"{frame:06d}.png"


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
        for name in ("Ks", "viewmats"):
            # As they are read: a capture's digest is of values of this type.
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))

    def __len__(self) -> int:
        return len(self.Ks)

    def camera(self, frame: int, width: int, height: int) -> Camera:
        """Return the camera of one frame, for images of a size in px."""
        return Camera(self.Ks[frame], self.viewmats[frame], width, height)


def check_cameras(Ks: np.ndarray, viewmats: np.ndarray, *, where: str) -> None:
    """Refuse cameras that cannot project: (F, 3, 3) px, and (F, 4, 4) world to camera."""
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
    for name, good, problem in rules:
        if not good.all():
            raise BadInput(f"frame {int(np.argmin(good))} has {problem}", where=where, field=name)


def read_cameras(path: str | os.PathLike[str], frame_count: int) -> Cameras:
    """Read `cameras.npz`."""
    arrays = read_npz(path)
    Ks = take(arrays, "Ks", (frame_count, 3, 3), where=path)
    viewmats = take(arrays, "viewmats", (frame_count, 4, 4), where=path)
    check_cameras(Ks, viewmats, where=os.fspath(path))
    return Cameras(Ks, viewmats)


def read_hands(
    path: str | os.PathLike[str], sides: tuple[str, ...], frame_count: int
) -> dict[str, HandParameters]:
    """Read `hands.npz`: for each side `{side}_pose`, `_betas`, `_transl`, `_valid`."""
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


def write_numbers(root: Path, hands: Mapping[str, HandParameters], cameras: Cameras) -> None:
    """Write `hands.npz` and `cameras.npz` of a folder."""
    write_npz(root / HANDS, hand_arrays(hands))
    write_npz(root / CAMERAS, vars(cameras))


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


def numbers_digests(hands: Mapping[str, HandParameters], cameras: Cameras) -> dict[str, str]:
    """Return the digests of a capture's `hands` and `cameras`."""
    return {
        "hands": arrays_digest(hand_arrays(hands)),
        "cameras": arrays_digest(vars(cameras)),
    }


# Largest file that is read, unpacked, in bytes: both hands of a MANO-HD have a tenth of it.
_MAX_BYTES = 128 * 1024 * 1024
# Farthest that a point of a hand at rest may be from the model's wrist, m.
_FARTHEST = 1.0


def write_subject_mesh(path: str | os.PathLike[str], templates: Mapping[str, HandTemplate]) -> None:
    """Write the rest hands of a subject by side: `truth/template.npz`.

    A subject may be another person than every shape of the hand model. Of a subject with the hand
    model's triangles, the file holds the surface, the joints it bends about, and its skinning; the
    rest of a template is the hand model's. It is truth with the capture and no part of its digest:
    it follows from the scene.
    """
    arrays = {
        f"{side}_{field}": getattr(template, field).astype(np.float32)
        for side, template in templates.items()
        for field in ("vertices", "joints", "weights")
    }
    write_npz(path, arrays)


def read_subject_mesh(path: str | os.PathLike[str], model: HandTemplate) -> HandTemplate:
    """Read one hand of a subject."""
    arrays = read_npz(path, max_bytes=_MAX_BYTES)
    count, side = len(model.vertices), model.side
    vertices = take(arrays, f"{side}_vertices", (count, 3), where=path)
    joints = take(arrays, f"{side}_joints", (JOINT_COUNT, 3), where=path)
    weights = take(arrays, f"{side}_weights", (count, JOINT_COUNT), where=path)
    for part, places in (("vertices", vertices), ("joints", joints)):
        if np.abs(places - model.joints[0]).max() > _FARTHEST:
            raise BadInput("lies 1 m away from the hand", where=path, field=f"{side}_{part}")
    sums = weights.sum(axis=1)
    if weights.min() < -1e-6 or np.abs(sums - 1.0).max() > 1e-3:
        raise BadInput("is negative or does not sum to 1", where=path, field=f"{side}_weights")
    weights = np.clip(weights, 0.0, None)
    return rebuilt(
        model,
        vertices=vertices,
        shape_basis=np.zeros_like(model.shape_basis),
        joints=joints,
        joint_basis=np.zeros_like(model.joint_basis),
        weights=weights / weights.sum(axis=1, keepdims=True),
    )
