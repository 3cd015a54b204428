"""Splits: the frames that train, validate and test (contiguous 80/10/10), and their audit."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from msgspec import Meta

from hwp_bench.base.errors import BadSplit
from hwp_bench.base.files import read_json, sha256_json, write_json
from hwp_bench.base.records import parse_record, without_schema

if TYPE_CHECKING:
    from hwp_bench.capture import Capture


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
    """Split a capture as the paper does: train [0, 0.8 n), validation to 0.9 n, test the rest."""
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
    """Read a split file."""
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
    """Return the split that a capture is evaluated with."""
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


#: Two frames whose thumbnails differ by less than this RMS (8-bit levels) count as near-copies;
#: the sensor noise of a phone gives about 2 at this thumbnail size.
NEAR_DUPLICATE_RMS = 2.0
#: Edge of the thumbnails, px.
THUMBNAIL = 32
#: Perceptual hashes (64 bits) that differ in at most this many bits count as one image; unlike
#: the RMS they see through another exposure, contrast or compression.
SAME_IMAGE_BITS = 4


@dataclass(frozen=True)
class AuditReport:
    """Findings of the audit of one split."""

    #: Id of the capture.
    capture: str
    #: Frames of each part.
    counts: dict[str, int]
    #: Frames that belong to no part: the guard gap.
    left_out: tuple[int, ...]
    #: Perturbed test frames, with the perturbation's name; must be empty.
    perturbed_test: tuple[tuple[int, str], ...]
    #: Perturbations whose severity is not known frame by frame, so that the audit proves nothing.
    unknown_severity: tuple[str, ...]
    #: Test frames that nearly equal a training or validation frame: (test, other, RMS).
    near_duplicates: tuple[tuple[int, int, float], ...]
    #: Smallest guard gap (frames left out before each border) that leaves no near-copy; None where
    #: none does, as the validation part would be empty.
    guard_needed: int | None
    #: Test frames whose perceptual hash is that of a training or validation frame, except for a few
    #: bits: (test, other, bits that differ).
    same_hashes: tuple[tuple[int, int, int], ...]
    #: Smallest guard gap that leaves none of them; None where none does.
    guard_needed_by_hash: int | None

    @property
    def ok(self) -> bool:
        """Whether no test frame is known to be perturbed."""
        return not self.perturbed_test


def audit_split(
    capture: Capture, split: Split, *, threshold: float = NEAR_DUPLICATE_RMS
) -> AuditReport:
    """Audit the split of a capture.

    Near-copies are reported, not judged: neighbouring frames of a still hand are alike in every
    video. `threshold` is in 8-bit levels.
    """
    parts = {part: np.arange(*split.range(part)).tolist() for part in PARTS}
    seen = {frame for frames in parts.values() for frame in frames}
    perturbations = capture.info.perturbations
    perturbed = [
        (frame, name)
        for frame in parts["test"]
        for name, values in perturbations.items()
        if values is not None and values[frame] > 0
    ]
    duplicates = _near_duplicates(capture, split, threshold)
    hashes = _same_hashes(capture, split)
    return AuditReport(
        capture=capture.info.id,
        counts={part: len(frames) for part, frames in parts.items()},
        left_out=tuple(frame for frame in range(split.frame_count) if frame not in seen),
        perturbed_test=tuple(perturbed),
        unknown_severity=tuple(n for n, values in perturbations.items() if values is None),
        near_duplicates=duplicates,
        guard_needed=_guard(split, (other for _, other, _ in duplicates)),
        same_hashes=hashes,
        guard_needed_by_hash=_guard(split, (other for _, other, _ in hashes)),
    )


def _guard(split: Split, others: Iterable[int]) -> int | None:
    """The smallest gap that leaves out frames of training and validation; None where none does."""
    first, second = split.validation_range[0], split.test_range[0]
    borders = ((first if other < split.train_range[1] else second, other) for other in others)
    gap = max((border - other for border, other in borders), default=0)
    return gap if gap < second - first else None


def _features(
    capture: Capture, split: Split, feature: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The frames that are not for test, and a feature of the test frames and of those."""
    others = np.concatenate([split.train, split.validation])
    with ThreadPoolExecutor() as pool:
        test, seen = (
            np.stack(list(pool.map(lambda frame: feature(capture.frame(frame)), frames.tolist())))
            for frames in (split.test, others)
        )
    return others, test, seen


def _same_hashes(capture: Capture, split: Split) -> tuple[tuple[int, int, int], ...]:
    """Pairs of frames with nearly one perceptual hash (OpenCV's PHash, 64 bits)."""
    import cv2

    def hashed(image: np.ndarray) -> np.ndarray:
        code = cv2.img_hash.pHash(image[:, :, ::-1].copy())
        return np.unpackbits(np.asarray(code, dtype=np.uint8).ravel()).astype(np.int32)

    others, test, seen = _features(capture, split, hashed)
    # Bits that differ: |a| + |b| - 2 a.b for vectors of zeros and ones.
    distance = test.sum(1)[:, None] + seen.sum(1)[None] - 2 * test @ seen.T
    rows, columns = np.nonzero(distance <= SAME_IMAGE_BITS)
    found = (split.test[rows], others[columns], distance[rows, columns])
    return tuple(zip(*(values.tolist() for values in found), strict=True))


def _near_duplicates(
    capture: Capture, split: Split, threshold: float
) -> tuple[tuple[int, int, float], ...]:
    import cv2

    def thumbnail(image: np.ndarray) -> np.ndarray:
        small = cv2.resize(image, (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
        return small.astype(np.float64).ravel()

    others, test, seen = _features(capture, split, thumbnail)
    # |a - b|^2 = |a|^2 + |b|^2 - 2 a.b, in float64: the difference of large numbers is small.
    squared = (test**2).sum(1)[:, None] + (seen**2).sum(1)[None] - 2 * test @ seen.T
    rms = np.sqrt(np.maximum(squared, 0) / test.shape[1])
    rows, columns = np.nonzero(rms < threshold)
    found = (split.test[rows], others[columns], rms[rows, columns])
    return tuple(zip(*(values.tolist() for values in found), strict=True))
