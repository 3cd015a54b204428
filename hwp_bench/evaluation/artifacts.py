"""The files that an evaluation keeps with its scores: predictions, log, diagnostics, images."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.drawing import error_map, fitted, labelled, sheet
from hwp_bench.base.evenly import evenly
from hwp_bench.base.files import atomic_write
from hwp_bench.base.images import write_image
from hwp_bench.base.trees import remove_tree
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.evaluation.scoring import (
    MAX_PREDICTION_BYTES,
    Prediction,
    Target,
    predictions_digest,
    read_prediction,
    read_predictions,
    read_targets,
    score_predictions,
)
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.score import Network
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import CaptureResult, FrameResult, FreeViewResult
from hwp_bench.run.sandbox.supervise import MAX_LOG_BYTES
from hwp_bench.run.worker import DIAGNOSTICS, LOG

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
    """Keep predictions, log and diagnostics of a run, and draw images; drop the rest of the run."""
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
    """Write `worst.png`, `median.png`, `best.png` and one sheet of the three."""
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


#: Folder of the predicted frames inside the result folder of a capture.
FREE_PREDICTIONS = "free"
#: The picture of some of them, with the other pictures of a capture.
FREE_PICTURE = "free_view.png"
#: Views that the picture shows, and the larger edge of each, px.
FREE_VIEWS, FREE_EDGE = 6, 176


@dataclass(frozen=True, eq=False)
class FreeViewScores:
    """A scored clip, with what its picture needs."""

    #: The scores.
    result: FreeViewResult
    #: The truth.
    targets: Sequence[Target]
    #: One for each target.
    predictions: Sequence[Prediction]
    #: Folder that the predictions were read from.
    source: Path


def read_free_targets(capture: Capture) -> list[Target]:
    """Read the truth of the free-view clip; empty where the capture has none."""
    clip = capture.free_view
    return [] if clip is None else read_targets(clip, range(len(clip)))


def score_free_view(
    capture: Capture,
    targets: Sequence[Target],
    folder: Path | None,
    networks: Mapping[str, Network],
) -> FreeViewScores | None:
    """Score predictions of the clip in every protocol."""
    clip = capture.free_view
    if clip is None or folder is None:
        return None
    frames = [target.frame for target in targets]
    predictions = read_predictions(folder, frames, clip.size)
    scores = score_predictions(targets, predictions, networks)
    result = FreeViewResult(clip.digest, scores, predictions_digest(predictions))
    return FreeViewScores(result, targets, predictions, folder)


def keep_free_view(folder: Path, scores: FreeViewScores) -> None:
    """Keep the predictions and a picture in the result folder of a capture."""
    frames = [target.frame for target in scores.targets]
    keep_predictions(folder / FREE_PREDICTIONS, scores.source, frames)
    write_image(folder / "pictures" / FREE_PICTURE, free_view_picture(scores))


def free_view_picture(scores: FreeViewScores) -> np.ndarray:
    """Draw views spread over the clip, the truth above the prediction, on the scored pixels."""
    truths, drawn = [], []
    for place in evenly(len(scores.targets), FREE_VIEWS).tolist():
        target, prediction = scores.targets[place], scores.predictions[place]
        inside = scored_pixels(target.mask, erosion=HWP_V1.mask_erosion, coverage=target.exact)[
            :, :, None
        ]
        label = "no prediction"
        pixels = np.zeros_like(target.pixels)
        if prediction.pixels is not None:
            pixels = prediction.pixels
            label = f"PSNR {scores.result.frames[place].scores['psnr']:.2f} dB"
        truth = np.where(inside, target.pixels, 0)
        truths.append(labelled(fitted(truth, FREE_EDGE), f"truth, frame {target.frame}"))
        drawn.append(labelled(fitted(np.where(inside, pixels, 0), FREE_EDGE), label))
    return sheet([*truths, *drawn], columns=len(truths))


def write_side_by_side(
    path: Path, sources: Sequence[ResultsSource], captures: Sequence[Capture]
) -> Path:
    """Draw a row for each capture: its truth and every method, on the scored pixels.

    The frame is that of the median score, in the mean over the methods: nobody chooses it.
    """
    tiles = []
    for capture in captures:
        found = [_result(source, capture.info.id) for source in sources]
        frame = _typical_frame(found)
        target = capture.frame(frame)
        mask, exact = capture.scoring_mask(frame)
        region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        box = square_around(region)

        def tile(
            pixels: np.ndarray | None,
            text: str,
            region: np.ndarray = region,
            box: tuple[slice, slice] = box,
        ) -> np.ndarray:
            image = np.zeros((*region.shape, 3), np.uint8) if pixels is None else pixels
            inside = np.where(region[..., None], image, 0)[box]
            return labelled(fitted(inside, EDGE), text)

        tiles.append(tile(target, f"truth: {capture.info.id}, frame {frame}"))
        for source, result in zip(sources, found, strict=True):
            folder = source.place(result.id, "predictions")
            pixels = read_prediction(folder, frame, capture.size).pixels if folder else None
            psnr = next(item.scores["psnr"] for item in result.frames if item.frame == frame)
            tiles.append(tile(pixels, f"{source.results.method.title}, {psnr:.1f} dB"))
    return write_image(path, sheet(tiles, columns=1 + len(sources)))


def _typical_frame(found: Sequence[CaptureResult]) -> int:
    """The frame of the median score, in the mean over the methods."""
    scores = np.mean([[frame.scores["psnr"] for frame in one.frames] for one in found], axis=0)
    order = np.argsort(scores, kind="stable")
    return found[0].frames[int(order[len(order) // 2])].frame


def square_around(region: np.ndarray) -> tuple[slice, slice]:
    """The smallest square window around some pixels, or as much of it as the image has."""
    rows, columns = (np.nonzero(region.any(axis=axis))[0] for axis in (1, 0))
    if not len(rows):
        return slice(None), slice(None)
    edge = max(np.ptp(rows), np.ptp(columns)) + 1
    windows = []
    for places, size in zip((rows, columns), region.shape, strict=True):
        start = max(0, min((places[0] + places[-1] + 1 - edge) // 2, size - edge))
        windows.append(slice(int(start), int(start + edge)))
    return windows[0], windows[1]


def _result(source: ResultsSource, capture: str) -> CaptureResult:
    return next(item for item in source.results.captures if item.id == capture)
