"""Results with predictions that a test draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.results import FrameResult, Results, write_results


def drawn_results(
    capture: Capture, folder: Path, example: Results, draw: Callable[[int], np.ndarray]
) -> Path:
    """Write a result on a capture, with predictions of its test frames.

    Args:
        capture: what was evaluated.
        folder: of the results.
        example: everything else of them; the scores are no scores of the predictions.
        draw: gives the prediction of a frame, (H, W, 3) uint8.
    """
    split = contiguous_split(capture.info.id, len(capture))
    frames = split.test.tolist()
    scored = replace(
        example.captures[0],
        id=capture.info.id,
        digest=capture.digest,
        split_digest=split.digest,
        frames=[FrameResult(frame, {"psnr": 20.0}, None) for frame in frames],
    )
    for frame in frames:
        target = folder / "captures" / capture.info.id / "predictions" / frame_name(frame)
        write_image(target, draw(frame))
    write_results(folder / "results.json", replace(example, captures=[scored]))
    return folder
