"""The files that an evaluation keeps with its scores: predictions, log, diagnostics, images."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import error_map, fitted, labelled, sheet
from hwp_bench.base.files import atomic_write
from hwp_bench.base.folders import remove_tree
from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.evaluation.scoring import (
    MAX_PREDICTION_BYTES,
    ScoredFrames,
    read_prediction,
    read_targets,
)
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import FrameResult
from hwp_bench.run.sandbox.supervise import MAX_LOG_BYTES
from hwp_bench.run.worker import DIAGNOSTICS, LOG

#: Most bytes of temporal weights and weight masks that are kept of a capture.
MAX_DIAGNOSTICS = 64 << 20
#: Larger side of a tile, px.
EDGE = 256
#: Folder of the predicted frames inside the result folder of a capture.
FREE_PREDICTIONS = "free"
#: The picture of some of them, with the other pictures of a capture.
FREE_PICTURE = "free_view.png"
#: Views that the picture shows, and the larger edge of each, px.
FREE_VIEWS, FREE_EDGE = 6, 176


def keep_artifacts(
    folder: Path, output: Path, frames: ScoredFrames, free_view: ScoredFrames | None
) -> None:
    """Keep what a run left (predictions, log, diagnostics) in the folder of a capture's result.

    Draws pictures of it, and drops the rest of the run.
    """
    for scored, name in ((frames, "predictions"), (free_view, FREE_PREDICTIONS)):
        if scored is not None:
            keep_predictions(folder / name, scored.source, [one.frame for one in scored.targets])
    if (output / LOG).is_file():
        keep_log(output / LOG, folder / LOG)
    keep_diagnostics(output / DIAGNOSTICS, folder / DIAGNOSTICS)
    remove_tree(output)
    if any(frame.failure is None for frame in frames.scores):
        write_pictures(folder / "pictures", frames)
    if free_view is not None:
        write_image(folder / "pictures" / FREE_PICTURE, free_view_picture(free_view))


def keep_log(source: Path, target: Path) -> None:
    """Copy a log, or as much of what a method put in its place as the toolkit itself would keep."""
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


def write_pictures(folder: Path, scored: ScoredFrames) -> None:
    """Write `worst.png`, `median.png`, `best.png` and one sheet of the three, `comparison.png`.

    A row a frame: truth in full, then truth, prediction and error on the scored pixels.
    """
    tiles = []
    for name, place in find_extreme_frames(scored.scores).items():
        target = scored.targets[place]
        pixels, label = _prediction(scored, place)
        wrong = error_map(pixels, target.pixels, target.region)
        row = [
            labelled(fitted(image, EDGE), text)
            for image, text in (
                (target.pixels, f"{name}: frame {target.frame}"),
                (target.masked(target.pixels), "truth, scored pixels"),
                (target.masked(pixels), f"prediction, {label}"),
                (wrong, "error (yellow: 64 levels)"),
            )
        ]
        write_image(folder / f"{name}.png", sheet(row, columns=len(row)))
        tiles += row
    write_image(folder / "comparison.png", sheet(tiles, columns=4))


def _prediction(scored: ScoredFrames, place: int) -> tuple[np.ndarray, str]:
    """A predicted image (H, W, 3), black where there is none, and what its tile says."""
    pixels = scored.predictions[place].pixels
    if pixels is None:
        return np.zeros_like(scored.targets[place].pixels), "no prediction"
    return pixels, f"PSNR {scored.scores[place].scores['psnr']:.2f} dB"


def find_extreme_frames(frames: Sequence[FrameResult]) -> dict[str, int]:
    """Return the positions of the frames of worst, median and best PSNR in a list of results."""
    order = np.argsort([frame.scores["psnr"] for frame in frames], kind="stable").tolist()
    return {"worst": order[0], "median": order[len(order) // 2], "best": order[-1]}


def free_view_picture(scored: ScoredFrames) -> np.ndarray:
    """Draw views spread over the clip, the truth above the prediction, on the scored pixels.

    (H, W, 3) uint8: a column a view.
    """
    truths, drawn = [], []
    for place in evenly(len(scored.targets), FREE_VIEWS).tolist():
        target = scored.targets[place]
        pixels, label = _prediction(scored, place)
        truth = fitted(target.masked(target.pixels), FREE_EDGE)
        truths.append(labelled(truth, f"truth, frame {target.frame}"))
        drawn.append(labelled(fitted(target.masked(pixels), FREE_EDGE), label))
    return sheet([*truths, *drawn], columns=len(truths))


def write_side_by_side(
    path: Path, sources: Sequence[ResultsSource], captures: Sequence[Capture]
) -> Path:
    """Draw a row for each capture: its truth and every method, on the scored pixels.

    The frame is that of the median score, in the mean over the methods: nobody chooses it.
    """
    tiles = []
    for capture in captures:
        name = capture.info.id
        found = [next(one for one in s.results.captures if one.id == name) for s in sources]
        scores = np.mean([[row.scores["psnr"] for row in one.frames] for one in found], axis=0)
        order = np.argsort(scores, kind="stable")
        frame = found[0].frames[int(order[len(order) // 2])].frame
        [target] = read_targets(capture, [frame])
        images: list[tuple[np.ndarray | None, str]] = [
            (target.pixels, f"truth: {name}, frame {frame}")
        ]
        for source, result in zip(sources, found, strict=True):
            folder = source.place(result.id, "predictions")
            pixels = read_prediction(folder, frame, capture.size).pixels if folder else None
            psnr = next(item.scores["psnr"] for item in result.frames if item.frame == frame)
            images.append((pixels, f"{source.results.method.title}, {psnr:.1f} dB"))
        box = square_around(target.region)
        tiles += [labelled(fitted(target.masked(image)[box], EDGE), text) for image, text in images]
    return write_image(path, sheet(tiles, columns=1 + len(sources)))


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
