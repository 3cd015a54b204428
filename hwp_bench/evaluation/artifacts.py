"""The files that an evaluation keeps with its scores: predictions, log, diagnostics, images."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hwp_bench.base.drawing import error_map, fitted, labelled, sheet
from hwp_bench.base.files import atomic_write
from hwp_bench.base.folders import remove_tree
from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.evaluation.scoring import MAX_PREDICTION_BYTES, Prediction
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.results import FrameResult
from hwp_bench.run.output import DIAGNOSTICS, LOG
from hwp_bench.run.sandbox.supervise import MAX_LOG_BYTES

#: Most bytes of temporal weights and weight masks that are kept of a capture.
MAX_DIAGNOSTICS = 64 << 20
#: Larger side of a tile, px.
EDGE = 256


def keep_artifacts(
    folder: Path,
    output: Path,
    source: Path,
    capture: Capture,
    scores: Sequence[FrameResult],
    predictions: Sequence[Prediction],
) -> None:
    """Keep predictions, log and diagnostics of a run, and draw images; drop the rest of the run.

    Args:
        folder: the result folder of the capture.
        output: output folder of the run, which is removed.
        source: folder of the predicted frames.
        capture: the capture.
        scores: the scores of the test frames.
        predictions: their predictions, in the same order.
    """
    keep_predictions(folder / "predictions", source, [item.frame for item in predictions])
    if (output / LOG).is_file():
        keep_log(output / LOG, folder / LOG)
    keep_diagnostics(output / DIAGNOSTICS, folder / DIAGNOSTICS)
    remove_tree(output)
    if any(frame.failure is None for frame in scores):
        write_pictures(folder / "pictures", capture, scores, predictions)


def keep_log(source: Path, target: Path) -> None:
    """Copy a log, at most as much of it as the toolkit itself keeps of a method's output.

    A method may have put another file in its place.
    """
    with open(source, "rb") as stream:
        # What is kept of both ends, and the line between them.
        atomic_write(target, stream.read(MAX_LOG_BYTES + 1024))


def keep_predictions(folder: Path, source: Path, frames: Sequence[int]) -> None:
    """Copy the predicted frames that exist into a results folder; nothing else is copied.

    Of one that is too large to be read only the size is kept, in a file of holes that takes no
    room: it fails in a verification as it did here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for frame in frames:
        path = source / frame_name(frame)
        if not path.is_file() or path.is_symlink():
            continue
        if path.stat().st_size > MAX_PREDICTION_BYTES:
            (folder / path.name).touch()
            os.truncate(folder / path.name, MAX_PREDICTION_BYTES + 1)
        else:
            shutil.copyfile(path, folder / path.name)


def keep_diagnostics(source: Path, target: Path) -> None:
    """Copy temporal weights and weight masks, nothing else, up to `MAX_DIAGNOSTICS` bytes."""
    remove_tree(target)
    total = 0
    for path in sorted([*source.glob("*temporal.json"), *source.glob("weights/*.png")]):
        if path.is_symlink() or path.parent.is_symlink() or not path.is_file():
            continue
        total += path.stat().st_size
        if total > MAX_DIAGNOSTICS:
            break
        kept = target / path.relative_to(source)
        kept.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, kept)


def write_pictures(
    folder: Path,
    capture: Capture,
    frames: Sequence[FrameResult],
    predictions: Sequence[Prediction],
) -> Path:
    """Write `worst.png`, `median.png`, `best.png` and one sheet of the three.

    Args:
        folder: where to.
        capture: the capture.
        frames: the scores of the test frames.
        predictions: their predictions, in the same order.

    Returns:
        The sheet, `comparison.png`: a row a frame; truth in full, then truth, prediction and
        error on the scored pixels.
    """
    tiles = []
    for name, position in telling_frames(frames).items():
        row = _row(name, capture, frames[position], predictions[position])
        write_image(folder / f"{name}.png", sheet(row, columns=len(row)))
        tiles += row
    return write_image(folder / "comparison.png", sheet(tiles, columns=4))


def _row(
    name: str, capture: Capture, result: FrameResult, prediction: Prediction
) -> list[np.ndarray]:
    target = capture.frame(result.frame)
    mask, exact = capture.scoring_mask(result.frame)
    region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
    if prediction.pixels is None:
        pixels, label = np.zeros_like(target), "no prediction"
    else:
        pixels, label = prediction.pixels, f"PSNR {result.scores['psnr']:.2f} dB"
    inside = region[:, :, None]
    return [
        labelled(fitted(target, EDGE), f"{name}: frame {result.frame}"),
        labelled(fitted(np.where(inside, target, 0), EDGE), "truth, scored pixels"),
        labelled(fitted(np.where(inside, pixels, 0), EDGE), f"prediction, {label}"),
        labelled(fitted(error_map(pixels, target, region), EDGE), "error (yellow: 64 levels)"),
    ]


def telling_frames(frames: Sequence[FrameResult], metric: str = "psnr") -> dict[str, int]:
    """Return the positions of the worst, median and best frame in a list of results."""
    order = np.argsort([frame.scores[metric] for frame in frames], kind="stable")
    return {
        "worst": int(order[0]),
        "median": int(order[len(order) // 2]),
        "best": int(order[-1]),
    }
