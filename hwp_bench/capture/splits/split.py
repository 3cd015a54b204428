"""A split of one capture into training, validation and test frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadSplit
from hwp_bench.base.files import sha256_json

#: The three parts, in temporal order.
PARTS = ("train", "validation", "test")
#: Fewest frames of a capture that can be split 80/10/10 with no part empty.
MIN_FRAMES = 10


@dataclass(frozen=True)
class Split:
    """Contiguous parts of one capture; frames in a guard gap belong to none.

    Each part is a half-open range (start, stop) of frame indices.

    Raises:
        BadSplit: a part is empty, leaves the capture, or the parts overlap or are out of order.
    """

    #: Id of the capture.
    capture: str
    #: Frames of the capture.
    frame_count: int
    #: Frames that a method fits.
    train_range: tuple[int, int]
    #: Frames for choosing settings; a method may look at them.
    validation_range: tuple[int, int]
    #: The clean clip; a method never sees these frames.
    test_range: tuple[int, int]

    def __post_init__(self) -> None:
        stop_before = 0
        for part in PARTS:
            start, stop = self.range(part)
            if not start < stop:
                raise BadSplit(
                    f"no frame is left ({start} to {stop})",
                    where=self.capture,
                    field=part,
                    remedy=f"A capture needs at least {MIN_FRAMES} frames, more with a guard gap.",
                )
            if start < stop_before or stop > self.frame_count:
                raise BadSplit(
                    f"frames {start} to {stop} overlap another part or leave the capture "
                    f"of {self.frame_count} frames",
                    where=self.capture,
                    field=part,
                )
            stop_before = stop

    def range(self, part: str) -> tuple[int, int]:
        """Return (start, stop) of `train`, `validation` or `test`."""
        return getattr(self, f"{part}_range")

    @property
    def train(self) -> np.ndarray:
        """Indices of the training frames, ascending."""
        return np.arange(*self.train_range)

    @property
    def validation(self) -> np.ndarray:
        """Indices of the validation frames, ascending."""
        return np.arange(*self.validation_range)

    @property
    def test(self) -> np.ndarray:
        """Indices of the test frames, ascending."""
        return np.arange(*self.test_range)

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the split's content."""
        return sha256_json(self._content())

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object that `from_json` reads, with its digest."""
        return {**self._content(), "digest": self.digest}

    def _content(self) -> dict[str, Any]:
        ranges = {part: list(self.range(part)) for part in PARTS}
        return {"capture": self.capture, "frame_count": self.frame_count, **ranges}

    @classmethod
    def from_json(cls, value: Any, *, where: str) -> Split:
        """Check a JSON object and make a split of it.

        Raises:
            BadSplit: a field is missing or wrong, or the digest does not match.
        """
        if not isinstance(value, dict):
            raise BadSplit("must be a JSON object", where=where)
        name, count = value.get("capture"), value.get("frame_count")
        if not isinstance(name, str) or not isinstance(count, int) or not _whole(count):
            raise BadSplit("needs a capture id and a frame count", where=where)
        ranges = {}
        for part in PARTS:
            pair = value.get(part)
            if not isinstance(pair, list) or len(pair) != 2 or not all(_whole(n) for n in pair):
                raise BadSplit("must be [start, stop]", where=where, field=f"{name}.{part}")
            ranges[f"{part}_range"] = tuple(pair)
        split = cls(capture=name, frame_count=count, **ranges)
        if value.get("digest") != split.digest:
            raise BadSplit(
                "does not match the frames that are listed",
                where=where,
                field=f"{name}.digest",
                remedy="The split was edited; get the original file.",
            )
        return split


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def contiguous_split(capture: str, frame_count: int, *, guard: int = 0) -> Split:
    """Split a capture as the paper does: train [0, 0.8 n), validation to 0.9 n, test the rest.

    Args:
        capture: id of the capture.
        frame_count: its number of frames n, at least 10.
        guard: frames that are left out at the end of training and of validation, so that
            neighbours of a test or validation frame are never trained on.

    Returns:
        The split. The bounds are rounded down, as in the released loader.

    Raises:
        BadSplit: too few frames.
    """
    if frame_count < MIN_FRAMES:
        raise BadSplit(
            f"has {frame_count} frames, too few to split 80/10/10",
            where=capture,
            remedy=f"A capture needs at least {MIN_FRAMES} frames.",
        )
    # Integer arithmetic: 0.8 * n in floating point can land below a whole number.
    first, second = frame_count * 8 // 10, frame_count * 9 // 10
    return Split(
        capture=capture,
        frame_count=frame_count,
        train_range=(0, first - guard),
        validation_range=(first, second - guard),
        test_range=(second, frame_count),
    )
