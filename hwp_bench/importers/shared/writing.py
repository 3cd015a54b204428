"""Writing an imported capture: frames, masks, the overlay sheet and the import's own report."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from hwp_bench.base.console import progress
from hwp_bench.base.files import refuse_existing as refuse_folder
from hwp_bench.capture import Cameras, CaptureInfo, CaptureWriter
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.importers.shared.frames_parallel import each_frame

#: Name of the overlay sheet among the capture's extra files.
SHEET_NAME = "overlay.png"
#: Name of the report among the capture's extra files.
REPORT_NAME = "import.json"


def refuse_existing(out: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Refuse an output folder before minutes of work, not after them.

    Args:
        out: the capture folder to make.
        overwrite: whether a folder that is not empty may be replaced.

    Raises:
        UsageError: `out` is a file, or a folder that is not empty.
    """
    refuse_folder(out, overwrite=overwrite, flag="--force")


def write_capture(
    out: str | os.PathLike[str],
    info: CaptureInfo,
    hands: Mapping[str, HandParameters],
    cameras: Cameras,
    frames: Iterable[tuple[np.ndarray, np.ndarray]],
    sheet: Callable[[], np.ndarray],
    facts: Mapping[str, Any],
    *,
    overwrite: bool,
) -> None:
    """Write a capture, whole or not at all.

    Args:
        out: the capture folder to make.
        info: the capture's description.
        hands: parameters by side.
        cameras: one camera a frame.
        frames: for each frame its image (H, W, 3) uint8 sRGB and its mask (H, W) uint8.
        sheet: draws the overlay sheet, (H, W, 3) uint8; called once all frames are written.
        facts: the numbers that measure the import, stored as JSON.
        overwrite: replace an existing folder.
    """
    import cv2

    with (
        CaptureWriter(out, info, hands, cameras, overwrite=overwrite) as writer,
        progress("writing the capture", info.frame_count) as update,
    ):

        def store(numbered: tuple[int, tuple[np.ndarray, np.ndarray]]) -> int:
            frame, (image, mask) = numbered
            writer.frame(frame, image)
            writer.mask(frame, mask)
            return frame

        for frame in each_frame(store, enumerate(frames)):
            update(frame + 1)
        writer.extra(SHEET_NAME, cv2.imencode(".png", sheet()[:, :, ::-1])[1].tobytes())
        writer.extra(REPORT_NAME, json.dumps(dict(facts), indent=1) + "\n")
