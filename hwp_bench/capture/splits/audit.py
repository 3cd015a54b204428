"""Audit a split: disjoint parts, a clean test clip, no near-copies across the border."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.capture.splits.split import PARTS, Split

if TYPE_CHECKING:
    from hwp_bench.capture import Capture

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
    #: Frames that belong to more than one part; must be empty.
    overlap: tuple[int, ...]
    #: Frames that belong to no part: the guard gap.
    left_out: tuple[int, ...]
    #: Perturbed test frames, with the perturbation's name; must be empty.
    perturbed_test: tuple[tuple[int, str], ...]
    #: Perturbations whose severity is not known frame by frame, so that the audit proves nothing.
    unknown_severity: tuple[str, ...]
    #: Test frames that nearly equal a training or validation frame: (test, other, RMS).
    near_duplicates: tuple[tuple[int, int, float], ...]
    #: Smallest guard gap (frames before the test clip) that leaves no near-copy.
    guard_needed: int
    #: Test frames whose perceptual hash is that of a training or validation frame, except for a few
    #: bits: (test, other, bits that differ).
    same_hashes: tuple[tuple[int, int, int], ...]
    #: Smallest guard gap that leaves none of them.
    guard_needed_by_hash: int

    @property
    def ok(self) -> bool:
        """Whether the parts are disjoint and no test frame is known to be perturbed."""
        return not self.overlap and not self.perturbed_test


def audit_split(
    capture: Capture,
    split: Split,
    *,
    threshold: float = NEAR_DUPLICATE_RMS,
    bits: int = SAME_IMAGE_BITS,
) -> AuditReport:
    """Audit the split of a capture.

    Args:
        capture: the capture.
        split: its split.
        threshold: RMS difference of 32x32 thumbnails, in 8-bit levels, below which two frames
            count as near-copies.
        bits: most bits in which the perceptual hashes of one image differ.

    Returns:
        The report; near-copies are reported, not judged, because neighbouring frames of a still
        hand are alike in every video.
    """
    parts = {part: set(np.arange(*split.range(part)).tolist()) for part in PARTS}
    seen: dict[int, int] = {}
    for frames in parts.values():
        for frame in frames:
            seen[frame] = seen.get(frame, 0) + 1
    perturbations = capture.info.perturbations
    perturbed = [
        (frame, name)
        for frame in sorted(parts["test"])
        for name, values in perturbations.items()
        if values is not None and values[frame] > 0
    ]
    duplicates = _near_duplicates(capture, split, threshold)
    hashes = _same_hashes(capture, split, bits)
    return AuditReport(
        capture=capture.info.id,
        counts={part: len(frames) for part, frames in parts.items()},
        overlap=tuple(sorted(frame for frame, count in seen.items() if count > 1)),
        left_out=tuple(frame for frame in range(split.frame_count) if frame not in seen),
        perturbed_test=tuple(perturbed),
        unknown_severity=tuple(n for n, values in perturbations.items() if values is None),
        near_duplicates=duplicates,
        guard_needed=_guard(split, (other for _, other, _ in duplicates)),
        same_hashes=hashes,
        guard_needed_by_hash=_guard(split, (other for _, other, _ in hashes)),
    )


def _guard(split: Split, others: Iterable[int]) -> int:
    return max((split.test_range[0] - other for other in others), default=0)


def _same_hashes(capture: Capture, split: Split, bits: int) -> tuple[tuple[int, int, int], ...]:
    """Pairs of frames with nearly one perceptual hash (OpenCV's PHash, 64 bits)."""
    import cv2

    def hashed(frame: int) -> np.ndarray:
        code = cv2.img_hash.pHash(capture.frame(frame)[:, :, ::-1].copy())
        return np.unpackbits(np.asarray(code, dtype=np.uint8).ravel())

    others = np.concatenate([split.train, split.validation])
    with ThreadPoolExecutor() as pool:
        test = np.stack(list(pool.map(hashed, split.test.tolist()))).astype(np.int32)
        seen = np.stack(list(pool.map(hashed, others.tolist()))).astype(np.int32)
    # Bits that differ: |a| + |b| - 2 a.b for vectors of zeros and ones.
    distance = test.sum(1)[:, None] + seen.sum(1)[None] - 2 * test @ seen.T
    pairs = np.argwhere(distance <= bits)
    return tuple(
        (int(split.test[row]), int(others[column]), int(distance[row, column]))
        for row, column in pairs
    )


def _near_duplicates(
    capture: Capture, split: Split, threshold: float
) -> tuple[tuple[int, int, float], ...]:
    import cv2

    def thumbnail(frame: int) -> np.ndarray:
        small = cv2.resize(
            capture.frame(frame), (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA
        )
        return small.astype(np.float32).ravel()

    others = np.concatenate([split.train, split.validation])
    with ThreadPoolExecutor() as pool:
        test = np.stack(list(pool.map(thumbnail, split.test.tolist())))
        seen = np.stack(list(pool.map(thumbnail, others.tolist())))
    # |a - b|^2 = |a|^2 + |b|^2 - 2 a.b, in float64: the difference of large numbers is small.
    test, seen = test.astype(np.float64), seen.astype(np.float64)
    squared = (test**2).sum(1)[:, None] + (seen**2).sum(1)[None] - 2 * test @ seen.T
    rms = np.sqrt(np.maximum(squared, 0) / test.shape[1])
    pairs = np.argwhere(rms < threshold)
    return tuple(
        (int(split.test[row]), int(others[column]), float(rms[row, column]))
        for row, column in pairs
    )
