"""What a capture says of itself: the content of `capture.json`, checked field by field."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hwp_bench.base.errors import BadCapture
from hwp_bench.base.text import has_odd_characters
from hwp_bench.taxonomy import check_severity, perturbation

#: Version of the capture format; a reader refuses every other.
SCHEMA = "hwp-capture/1"
#: Most frames that a capture may claim.
MAX_FRAMES = 100_000
#: Largest edge of a frame, in pixels.
MAX_EDGE = 8192
#: Which hands a capture may hold, and the sides that it then has parameters for.
SIDES: Mapping[str, tuple[str, ...]] = {
    "right": ("right",),
    "left": ("left",),
    "both": ("right", "left"),
}
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class HandModelId:
    """Which hand model the parameters of a capture belong to."""

    #: Name of the template, such as `anny-1` or `mano`.
    name: str
    #: Digest of the template, hex.
    digest: str
    #: What `load_template` is given to have it, such as `anny` or `mano:PATH`.
    source: str = "anny"


@dataclass(frozen=True)
class CaptureInfo:
    """Everything about a capture except its pixels and numbers."""

    #: Name, unique within a benchmark: letters, digits, `.`, `_`, `-`.
    id: str
    #: `right`, `left` or `both`.
    hands: str
    #: What the hands do.
    action: str
    #: What recorded it.
    device: str
    #: Frames per second.
    fps: float
    #: Width of every frame, in pixels.
    width: int
    #: Height of every frame, in pixels.
    height: int
    #: Number of frames F.
    frame_count: int
    #: The hand model that `pose`, `betas` and `transl` belong to.
    hand_model: HandModelId
    #: Declared perturbations: severity 0-5 of every frame, or None where nobody knows.
    perturbations: Mapping[str, tuple[int, ...] | None]
    #: Where the capture comes from: any JSON object.
    source: Mapping[str, Any]
    #: Terms under which the frames may be used.
    licence: str
    #: SHA-256 of the content by part (`frames`, `masks`, `hands`, ...); empty before writing.
    digests: Mapping[str, str] | None = None

    @property
    def sides(self) -> tuple[str, ...]:
        """The hands that have parameters: `right`, `left` or both."""
        return SIDES[self.hands]

    @property
    def interacting(self) -> bool:
        """Whether two hands are in the picture (the paper's `interacting`)."""
        return self.hands == "both"

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
            "fps": self.fps,
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
        fields = _Fields(value, where)
        schema = fields.text("schema")
        if schema != SCHEMA:
            raise BadCapture(
                f"is {schema!r} where {SCHEMA!r} is read",
                where=where,
                field="schema",
                remedy="Write the capture again with this version of the toolkit.",
            )
        hands = fields.text("hands")
        if hands not in SIDES:
            raise BadCapture(
                f"is {hands!r}, not one of {', '.join(SIDES)}", where=where, field="hands"
            )
        model = _Fields(fields.mapping("hand_model"), where, "hand_model.")
        frame_count = fields.whole("frame_count", 1, MAX_FRAMES)
        info = cls(
            id=fields.text("id"),
            hands=hands,
            action=fields.text("action"),
            device=fields.text("device"),
            fps=fields.positive("fps"),
            width=fields.whole("width", 1, MAX_EDGE),
            height=fields.whole("height", 1, MAX_EDGE),
            frame_count=frame_count,
            hand_model=HandModelId(model.text("name"), model.text("digest"), model.text("source")),
            perturbations=_severities(fields.mapping("perturbations"), frame_count, where),
            source=fields.mapping("source"),
            licence=fields.text("licence"),
            digests=fields.mapping("digests"),
        )
        check_id(info.id, where)
        return info


def check_id(identifier: str, where: str) -> None:
    """Refuse a capture id that could not be a folder's name everywhere.

    Raises:
        BadCapture: it has other characters than letters, digits, `.`, `_`, `-`, or is too long.
    """
    if not _ID.fullmatch(identifier):
        raise BadCapture(
            f"{identifier!r} is no capture id",
            where=where,
            field="id",
            remedy="Use up to 100 letters, digits, dots, underscores and hyphens.",
        )


def _severities(
    value: Mapping[str, Any], frame_count: int, where: str
) -> dict[str, tuple[int, ...] | None]:
    checked: dict[str, tuple[int, ...] | None] = {}
    for name, values in value.items():
        field = f"perturbations.{name}"
        perturbation(name)
        if values is None:
            checked[name] = None
            continue
        if not isinstance(values, list | tuple) or len(values) != frame_count:
            raise BadCapture(
                f"must be null or a list of {frame_count} severities", where=where, field=field
            )
        checked[name] = check_severity(values, where=where, field=field)
    return checked


class _Fields:
    """Typed access to an untrusted JSON object."""

    def __init__(self, value: Any, where: str, prefix: str = "") -> None:
        self.where = where
        self.prefix = prefix
        if not isinstance(value, dict):
            raise BadCapture("must be a JSON object", where=where, field=prefix.rstrip("."))
        self.value = value

    def _get(self, name: str) -> Any:
        if name not in self.value:
            raise BadCapture("is missing", where=self.where, field=self.prefix + name)
        return self.value[name]

    def _refuse(self, name: str, what: str) -> BadCapture:
        return BadCapture(
            f"is {str(self.value[name])[:80]!r}, not {what}",
            where=self.where,
            field=self.prefix + name,
        )

    def text(self, name: str) -> str:
        value = self._get(name)
        if not isinstance(value, str) or not value or len(value) > 10_000:
            raise self._refuse(name, "a text of 1 to 10,000 characters")
        if has_odd_characters(value):
            raise self._refuse(name, "a text without control characters")
        return value

    def whole(self, name: str, low: int, high: int) -> int:
        value = self._get(name)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self._refuse(name, f"a whole number from {low} to {high}")
        return value

    def positive(self, name: str) -> float:
        value = self._get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e6:
            raise self._refuse(name, "a number above 0 and below a million")
        return float(value)

    def mapping(self, name: str) -> dict[str, Any]:
        value = self._get(name)
        if not isinstance(value, dict):
            raise self._refuse(name, "a JSON object")
        return value
