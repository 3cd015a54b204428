"""From predicted frames to scores: every frame that the split lists is scored, failures included.

Predictions are checked before they are scored; only the frames of a submission count.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadCapture, BadInput, HwpError, bounded
from hwp_bench.base.files import read_json
from hwp_bench.base.images import MAX_PIXELS, pixel_digest, read_rgb
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.metrics.pixels import decibels, scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.score import Network, ScoredFrame, score_frames
from hwp_bench.results import FrameResult

#: Bytes of a predicted frame: the largest image that is read, four channels, not packed.
MAX_PREDICTION_BYTES = 4 * MAX_PIXELS
#: The sentences about a capture, inside its result folder; absent where there are none.
WARNINGS = "warnings.json"
#: Share of the scored values that are 255 from which an image is taken to be clipped.
WHITE = 0.9
#: Gain by exchanging red and blue from which the order is doubted, dB.
EXCHANGE_GAIN = 3.0
#: Share of the frames that must be better with them exchanged.
EXCHANGE_FRAMES = 0.75


@dataclass(frozen=True, eq=False)
class Target:
    """The truth of one frame."""

    frame: int
    #: (H, W, 3) uint8 sRGB.
    pixels: np.ndarray
    #: (H, W) uint8, the data set's own visible-hand mask.
    mask: np.ndarray
    #: Whether the mask is exact coverage.
    exact: bool

    @cached_property
    def region(self) -> np.ndarray:
        """(H, W) bool: the scored pixels."""
        return scored_pixels(self.mask, erosion=HWP_V1.mask_erosion, coverage=self.exact)

    def masked(self, image: np.ndarray | None = None) -> np.ndarray:
        """(H, W, 3): an image, or nothing, black outside the scored pixels."""
        image = np.zeros_like(self.pixels) if image is None else image
        return np.where(self.region[..., None], image, np.uint8(0))


@dataclass(frozen=True, eq=False)
class Prediction:
    """One predicted frame, or the reason why it cannot be scored."""

    frame: int
    #: (H, W, 3) uint8 sRGB, or None.
    pixels: np.ndarray | None
    #: Why it cannot be scored, or None.
    failure: str | None


@dataclass(frozen=True, eq=False)
class ScoredFrames:
    """Predictions of some frames of a capture, or of its free-view clip, with their scores."""

    targets: Sequence[Target]
    #: One for each target, in the same order, as the scores.
    predictions: Sequence[Prediction]
    scores: list[FrameResult]
    #: Folder that the predictions were read from.
    source: Path

    @property
    def digest(self) -> str:
        """SHA-256 (hex) over the decoded pixels of the predictions."""
        return predictions_digest(self.predictions)


def score_frames_of(
    targets: Sequence[Target],
    source: Path,
    size: tuple[int, int],
    networks: Mapping[str, Network] | None = None,
) -> ScoredFrames:
    """Read and score the predictions of some frames of (height, width) px in a folder."""
    predictions = read_predictions(source, [target.frame for target in targets], size)
    scores = score_predictions(targets, predictions, networks)
    return ScoredFrames(targets, predictions, scores, source)


def read_scorable(capture: Capture, frames: Sequence[int]) -> list[Target]:
    """Read the truth of those of the given frames whose masks leave a pixel to score."""
    read = (Target(frame, capture.frame(frame), *capture.scoring_mask(frame)) for frame in frames)
    return [target for target in read if target.region.any()]


def read_targets(capture: Capture, frames: Sequence[int]) -> list[Target]:
    """Read the truth of the given frames, before any method runs.

    Raises:
        BadCapture: a mask leaves no pixel to score.
    """
    targets = read_scorable(capture, frames)
    found = {target.frame for target in targets}
    empty = [frame for frame in frames if frame not in found]
    if empty:
        one = len(empty) == 1
        words = ("mask of test frame", "leaves") if one else ("masks of test frames", "leave")
        raise BadCapture(
            f"the {words[0]} {bounded(empty)} {words[1]} no pixel to score",
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
    """Read one predicted frame."""
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
    """Score predictions in every protocol."""
    frames = [
        ScoredFrame(one.pixels, target.pixels, target.mask, coverage=target.exact)
        for target, one in zip(targets, predictions, strict=True)
    ]
    return [
        FrameResult(one.frame, scores, one.failure)
        for one, scores in zip(predictions, score_frames(frames, networks=networks), strict=True)
    ]


def predictions_digest(predictions: Sequence[Prediction]) -> str:
    """Return the SHA-256 (hex) over the decoded pixels of predictions, in order.

    A failed frame enters with its name, so that a later repair changes the digest.
    """
    parts = [
        f"failed {one.frame}" if one.pixels is None else pixel_digest(one.pixels)
        for one in predictions
    ]
    return hashlib.sha256("".join(parts).encode()).hexdigest()


# --- colours that cannot be meant: the scores are what they are, and these sentences tell an
# author why they may be so low


def colour_warnings(targets: Sequence[Target], predictions: Sequence[Prediction]) -> list[str]:
    """Return sentences about colours that cannot be meant, with the numbers; mostly none."""
    pairs = [
        (image[target.region].astype(np.float64), target.pixels[target.region].astype(np.float64))
        for target, prediction in zip(targets, predictions, strict=True)
        if (image := prediction.pixels) is not None
    ]
    if not pairs:
        return []
    drawn, true = (np.concatenate(part) for part in zip(*pairs, strict=True))
    means = f"their mean is {drawn.mean():.1f} of 255, the truth's {true.mean():.1f}"
    if drawn.max() <= 1 < true.max():
        return [
            f"no colour of the predictions is above {drawn.max():.0f} of 255 ({means}): were "
            "colours in [0, 1] stored without being multiplied by 255?"
        ]
    white, true_white = float((drawn == 255).mean()), float((true == 255).mean())
    if white > WHITE > 2 * true_white:
        return [
            f"{100 * white:.0f} % of the predicted colours are 255 ({means}): were colours in "
            "[0, 255] returned where [0, 1] is expected? They are clipped."
        ]
    return _exchange_warning(pairs)


def _exchange_warning(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[str]:
    """Compare the squared errors with those of the predictions with red and blue exchanged."""
    kept = np.array([((drawn - true) ** 2).mean() for drawn, true in pairs])
    swapped = np.array([((drawn[:, ::-1] - true) ** 2).mean() for drawn, true in pairs])
    before, after = (decibels(float(errors.mean()) / 255.0**2) for errors in (kept, swapped))
    if after - before < EXCHANGE_GAIN or (swapped < kept).mean() < EXCHANGE_FRAMES:
        return []
    return [
        f"with red and blue exchanged the predictions would have {after:.1f} dB in place of "
        f"{before:.1f} dB: are their channels in the order RGB?"
    ]


def read_warnings(folder: Path) -> list[str]:
    """Return the sentences that an evaluation left; none where the file is absent or damaged."""
    try:
        value = read_json(folder / WARNINGS, max_bytes=100_000)
    except BadInput:
        return []
    return [text for text in value if isinstance(text, str)] if isinstance(value, list) else []
