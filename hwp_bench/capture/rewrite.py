"""Write a capture again with other numbers; its pictures and masks stay as they are."""

from __future__ import annotations

import os
from collections.abc import Mapping

from hwp_bench.capture.reader import Capture
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.capture.writer import CaptureWriter
from hwp_bench.hands.parameters import HandParameters


def rewrite_capture(
    capture: Capture,
    out: str | os.PathLike[str],
    info: CaptureInfo,
    hands: Mapping[str, HandParameters],
    *,
    overwrite: bool = False,
) -> None:
    """Copy a capture with other hands. True hands are left out: they are of the old model.

    Args:
        capture: what is copied: frames, masks and known truth images.
        out: the capture folder to make.
        info: what the new capture says of itself.
        hands: its parameters by side.
        overwrite: replace an existing folder.

    Raises:
        UsageError: `out` exists.
        BadImage: an image of the capture is missing or damaged.
    """
    with CaptureWriter(out, info, hands, capture.cameras, overwrite=overwrite) as writer:
        for frame in range(len(capture)):
            writer.frame(frame, capture.frame(frame))
            writer.mask(frame, capture.mask(frame))
            if capture.has_true_masks:
                writer.true_mask(frame, capture.true_mask(frame))
            if capture.has_clean:
                writer.clean(frame, capture.clean(frame))
                writer.clean_mask(frame, capture.clean_mask(frame))
