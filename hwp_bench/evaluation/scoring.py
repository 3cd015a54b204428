"""From predicted frames to scores: every frame that the split lists is scored, failures included.

Predictions are checked before they are scored; only the frames of a submission count.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadCapture, BadPrediction, HwpError, bounded
from hwp_bench.base.images import MAX_PIXELS, pixel_digest, read_rgb
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.score import Frame, Network, score_frames
from hwp_bench.results import FrameResult

#: Bytes of a predicted frame: the largest image that is read, four channels, not packed.
MAX_PREDICTION_BYTES = 4 * MAX_PIXELS


@dataclass(frozen=True, eq=False)
class Target:
    """The truth of one frame."""

    #: Index in the capture.
    frame: int
    #: (H, W, 3) uint8 sRGB.
    pixels: np.ndarray
    #: (H, W) uint8, the data set's own visible-hand mask.
    mask: np.ndarray
    #: Whether the mask is exact coverage.
    exact: bool


@dataclass(frozen=True, eq=False)
class Prediction:
    """One predicted frame, or the reason why it cannot be scored."""

    #: Frame index in the capture.
    frame: int
    #: (H, W, 3) uint8 sRGB, or None.
    pixels: np.ndarray | None
    #: Why it cannot be scored, or None.
    failure: str | None


def read_targets(capture: Capture, frames: Sequence[int]) -> list[Target]:
    """Read the truth of the given frames, before any method runs.

    Raises:
        BadImage: a frame or mask is missing or damaged.
        BadCapture: frames show no hand that could be scored; no method can be blamed for it.
    """
    targets = []
    empty = []
    for frame in frames:
        mask, exact = capture.scoring_mask(frame)
        if not scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact).any():
            empty.append(frame)
            continue
        targets.append(Target(frame, capture.frame(frame), mask, exact))
    if empty:
        several = len(empty) > 1
        raise BadCapture(
            f"the mask{'s' if several else ''} of test frame{'s' if several else ''} "
            f"{bounded(empty)} leave{'' if several else 's'} no pixel to score",
            where=capture.root,
            field="masks",
            remedy="The test clip must show the hand in every frame.",
        )
    return targets


def read_predictions(
    folder: str | os.PathLike[str], frames: Iterable[int], size: tuple[int, int]
) -> list[Prediction]:
    """Read the predictions of the given frames, in that order; other files are ignored."""
    return [read_prediction(folder, frame, size) for frame in frames]


def read_prediction(
    folder: str | os.PathLike[str], frame: int, size: tuple[int, int]
) -> Prediction:
    """Read one predicted frame.

    Args:
        folder: where the predictions of a capture lie, `000123.png` for frame 123.
        frame: index of the frame.
        size: the capture's (height, width).

    Returns:
        The pixels, or a named failure: missing, a link, empty, larger than
        `MAX_PREDICTION_BYTES`, damaged, not 8-bit, of another size. An alpha channel is
        dropped: the data set owns the mask.
    """
    path = Path(folder) / frame_name(frame)
    # A link could lead to the very frame that is to be predicted.
    if path.is_symlink():
        return Prediction(frame, None, f"{path.name}: is a link")
    with contextlib.suppress(OSError):  # the reader says what is wrong with it
        if path.stat().st_size > MAX_PREDICTION_BYTES:
            return Prediction(frame, None, f"{path.name}: is larger than any image may be")
    try:
        return Prediction(frame, read_rgb(path, size), None)
    except HwpError as error:
        return Prediction(frame, None, f"{path.name}: {error.problem}")


def score_predictions(
    targets: Sequence[Target],
    predictions: Sequence[Prediction],
    networks: Mapping[str, Network] | None = None,
) -> list[FrameResult]:
    """Score predictions in every protocol.

    Args:
        targets: the truth.
        predictions: one for each target, in the same order.
        networks: LPIPS by backbone, where the weights are at hand.

    Returns:
        One result a target; a prediction that failed has the declared penalties.
    """
    frames = [
        Frame(
            BadPrediction(prediction.failure or "")
            if prediction.pixels is None
            else prediction.pixels,
            target.pixels,
            target.mask,
            coverage=target.exact,
        )
        for target, prediction in zip(targets, predictions, strict=True)
    ]
    return [
        FrameResult(target.frame, dict(score.values), score.failure)
        for target, score in zip(targets, score_frames(frames, networks=networks), strict=True)
    ]


def mean_scores(frames: Sequence[FrameResult]) -> dict[str, float]:
    """Return the mean of every metric over frames."""
    return {
        name: float(np.mean([frame.scores[name] for frame in frames])) for name in frames[0].scores
    }


def predictions_digest(predictions: Sequence[Prediction]) -> str:
    """Return the SHA-256 (hex) over the decoded pixels of predictions, in order.

    A failed frame enters with its name, so that a later repair changes the digest.
    """
    total = hashlib.sha256()
    for prediction in predictions:
        content = (
            f"failed {prediction.frame}"
            if prediction.pixels is None
            else pixel_digest(prediction.pixels)
        )
        total.update(content.encode())
    return total.hexdigest()
