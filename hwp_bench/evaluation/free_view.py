"""The free-view clip in an evaluation: scored as test frames are, kept and pictured apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import fitted, labelled, sheet
from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.evaluation.artifacts import keep_predictions
from hwp_bench.evaluation.scoring import (
    Prediction,
    Target,
    predictions_digest,
    read_predictions,
    read_targets,
    score_predictions,
)
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.score import Network
from hwp_bench.results import FreeViewResult

#: Folder of the predicted frames inside the result folder of a capture.
PREDICTIONS = "free"
#: The picture of some of them, with the other pictures of a capture.
PICTURE = "free_view.png"
#: Views that the picture shows, and the larger edge of each, px.
SHOWN, EDGE = 6, 176


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
    """Read the truth of the free-view clip; empty where the capture has none.

    Raises:
        BadCapture, BadImage: the clip is damaged, or a frame of it shows no hand.
    """
    clip = capture.free_view
    return [] if clip is None else read_targets(clip, range(len(clip)))


def score_free_view(
    capture: Capture,
    targets: Sequence[Target],
    folder: Path | None,
    networks: Mapping[str, Network],
) -> FreeViewScores | None:
    """Score predictions of the clip in every protocol.

    Args:
        capture: the capture with the clip.
        targets: what `read_free_targets` returned.
        folder: of the predictions, `000003.png` for frame 3. A missing frame has the declared
            penalties. None: nothing was offered, so that nothing is scored.
        networks: LPIPS by backbone, where the weights are at hand.

    Returns:
        the scores, or None where there is no clip or nothing was offered.
    """
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
    keep_predictions(folder / PREDICTIONS, scores.source, frames)
    write_image(folder / "pictures" / PICTURE, free_view_picture(scores))


def free_view_picture(scores: FreeViewScores) -> np.ndarray:
    """Draw views spread over the clip, the truth above the prediction, on the scored pixels.

    Returns:
        (H, W, 3) uint8: a column a view.
    """
    truths, drawn = [], []
    for place in evenly(len(scores.targets), SHOWN).tolist():
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
        truths.append(labelled(fitted(truth, EDGE), f"truth, frame {target.frame}"))
        drawn.append(labelled(fitted(np.where(inside, pixels, 0), EDGE), label))
    return sheet([*truths, *drawn], columns=len(truths))
