"""A capture folder: where its files lie, and `capture.json`, checked field by field."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.errors import BadCapture
from hwp_bench.base.records import Text, parse_record, without_schema
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
    #: Frames per second.
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

    def severity(self, frame: int) -> dict[str, int | None]:
        """Return the severity of every declared perturbation in one frame."""
        return {
            name: None if values is None else values[frame]
            for name, values in self.perturbations.items()
        }

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that `from_json` reads."""
        return {
            "schema": SCHEMA,
            "id": self.id,
            "hands": self.hands,
            "action": self.action,
            "device": self.device,
            "fps": float(self.fps),
            "width": self.width,
            "height": self.height,
            "frame_count": self.frame_count,
            "hand_model": {
                "name": self.hand_model.name,
                "digest": self.hand_model.digest,
                "source": self.hand_model.source,
            },
            "perturbations": {
                name: None if values is None else list(values)
                for name, values in self.perturbations.items()
            },
            "source": dict(self.source),
            "licence": self.licence,
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
        info = parse_record(
            cls, content, where=where, error=BadCapture, complete=True, ignore_unknown=True
        )
        _check_severities(info, where)
        check_id(info.id, where)
        return info


def check_id(identifier: str, where: str) -> None:
    """Refuse a capture id that could not be a folder's name everywhere.

    Raises:
        BadCapture: it has other characters than letters, digits, `.`, `_`, `-`, or is too long.
    """
    if not _ID.fullmatch(identifier):
        raise BadCapture(
            f"{identifier!r} is not a capture id",
            where=where,
            field="id",
            remedy="Use up to 100 letters, digits, dots, underscores and hyphens.",
        )


def _check_severities(info: CaptureInfo, where: str) -> None:
    for name, values in info.perturbations.items():
        place = f"perturbations.{name}"
        perturbation(name, where=where, field="perturbations")
        if values is None:
            continue
        if len(values) != info.frame_count:
            raise BadCapture(
                f"must be null or a list of {info.frame_count} severities", where=where, field=place
            )
        check_severity(values, where=where, field=place)


def image_path(root: Path, kind: str, frame: int) -> Path:
    """Return the file of one image: `kind` is a key of `IMAGE_FOLDERS`."""
    return root / IMAGE_FOLDERS[kind] / frame_name(frame)


def frame_name(frame: int) -> str:
    """Return the file name of a frame, as captures and predictions use it."""
    return f"{frame:06d}.png"
