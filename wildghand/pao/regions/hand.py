"""The hand's mask y_h of raw frames, without a network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hwp_bench.base.errors import ShapeMismatch


def graph_cut_hands(
    images: Sequence[np.ndarray], silhouettes: Sequence[np.ndarray]
) -> Iterator[np.ndarray]:
    """y_h of raw frames: graph cuts prompted by the projected hand, one colour model for all.

    Args:
        images: (H, W, 3) uint8 sRGB each.
        silhouettes: (H, W) bool each, where the posed hand would be seen if nothing covered it;
            where it is empty, so is the mask.

    Yields:
        (H, W) bool for each frame.

    Raises:
        ShapeMismatch: a silhouette that does not belong to its image.

    Source: `hwp_bench.importers.video.masks`, which the video import uses.
    """
    from hwp_bench.importers.video.masks import NARROW, Prompt, segment_clip

    if len(images) != len(silhouettes) or any(
        image.shape[:2] != drawn.shape for image, drawn in zip(images, silhouettes, strict=True)
    ):
        raise ShapeMismatch("do not fit the images", field="silhouettes")
    if not images:
        return

    def prompt(frame: int) -> Prompt:
        drawn = np.where(silhouettes[frame], 255, 0).astype(np.uint8)
        return Prompt(drawn, np.zeros(drawn.shape, dtype=bool), detected=True)

    segmented = segment_clip(
        lambda frame: np.ascontiguousarray(images[frame]),
        prompt,
        len(images),
        _hand_size(silhouettes),
        NARROW,
    )
    for _, masks in segmented:
        yield masks.hand > 127


def _hand_size(silhouettes: Sequence[np.ndarray]) -> float:
    """Median over the frames of the larger side of the silhouette's box, px."""
    sides = [
        max(np.ptp(np.flatnonzero(drawn.any(axis=axis))) + 1.0 for axis in (0, 1))
        for drawn in silhouettes
        if drawn.any()
    ]
    return float(np.median(sides)) if sides else 1.0
