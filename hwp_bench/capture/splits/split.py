"""Splits of captures into training, validation and test frames, and the files that hold them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from hwp_bench.base.errors import BadSplit
from hwp_bench.base.files import read_json, sha256_json, write_json
from hwp_bench.base.records import parse_record, without_schema

#: Version of the split files.
SCHEMA = "hwp-splits/1"

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
        name = value.get("capture") if isinstance(value, dict) else None
        item = parse_record(
            _SplitRecord,
            value,
            where=where,
            field=name[:100] if isinstance(name, str) else "",
            error=BadSplit,
            ignore_unknown=True,
        )
        split = cls(item.capture, item.frame_count, item.train, item.validation, item.test)
        if item.digest != split.digest:
            raise BadSplit(
                "does not match the frames that are listed",
                where=where,
                field=f"{split.capture}.digest",
                remedy="The split was edited; get the original file.",
            )
        return split


_Frame = Annotated[int, Meta(ge=0)]


@dataclass(frozen=True)
class _SplitRecord:
    """A split as files hold it."""

    capture: str
    frame_count: _Frame
    train: tuple[_Frame, _Frame]
    validation: tuple[_Frame, _Frame]
    test: tuple[_Frame, _Frame]
    digest: str


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
    # Integer arithmetic: 0.8 * n in floating point can land below an integer.
    first, second = frame_count * 8 // 10, frame_count * 9 // 10
    return Split(
        capture=capture,
        frame_count=frame_count,
        train_range=(0, first - guard),
        validation_range=(first, second - guard),
        test_range=(second, frame_count),
    )


def read_splits(path: str | os.PathLike[str]) -> Mapping[str, Split]:
    """Read a split file.

    Returns:
        The splits by capture id.

    Raises:
        BadInput: missing or damaged.
        BadSplit: a split is not sound, or its digest does not match.
    """
    value = read_json(path)
    where = os.fspath(path)
    listed = without_schema(value, SCHEMA, where=where, error=BadSplit).get("splits")
    if not isinstance(listed, list):
        raise BadSplit("must be a list", where=where, field="splits")
    splits: dict[str, Split] = {}
    for item in listed:
        split = Split.from_json(item, where=where)
        if split.capture in splits:
            raise BadSplit(f"{split.capture} is listed twice", where=where)
        splits[split.capture] = split
    return splits


def write_splits(path: str | os.PathLike[str], splits: Iterable[Split]) -> Path:
    """Write a split file atomically."""
    return write_json(path, {"schema": SCHEMA, "splits": [split.to_json() for split in splits]})


def split_for(
    capture_id: str, frame_count: int, splits: Mapping[str, Split] | None = None
) -> Split:
    """Return the split that a capture is evaluated with.

    Args:
        capture_id: id of the capture.
        frame_count: its number of frames.
        splits: splits by capture id; without them the 80/10/10 rule is applied.

    Raises:
        BadSplit: the capture is not listed, is listed with another length, or is too short.
    """
    if splits is None:
        return contiguous_split(capture_id, frame_count)
    if capture_id not in splits:
        raise BadSplit(
            "is not in the split file",
            where=capture_id,
            remedy=f"The file lists: {', '.join(sorted(splits))}.",
        )
    split = splits[capture_id]
    if split.frame_count != frame_count:
        raise BadSplit(
            f"has {frame_count} frames where its split is made for {split.frame_count}",
            where=capture_id,
            remedy="Use the capture that the split belongs to.",
        )
    return split
