"""The validation frames that choose what training frames cannot tell."""

from __future__ import annotations

from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.training import TrainingFrames, load_validation_frames

#: Frames that judge at most, and at least: one or two, which a fit to all frames leaves out, say
#: little.
MOST, LEAST = 8, 4


def judging_frames(training: TrainingCapture) -> TrainingFrames | None:
    """Read validation frames, which no step sees; None where they are too few to judge.

    Args:
        training: what may be seen of the capture.

    Raises:
        BadImage: an image is missing or damaged.
    """
    frames = load_validation_frames(training, MOST)
    return frames if len(frames) >= LEAST else None
