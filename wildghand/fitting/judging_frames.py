"""The validation frames that choose what training frames cannot tell."""

from __future__ import annotations

from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.training import TrainingFrames, load_validation_frames
from wildghand.model.settings import WildGHandSettings

#: Frames that judge at most, and at least: one or two, which a fit to all frames leaves out, say
#: little.
MOST, LEAST = 8, 4


def judging_frames(training: TrainingCapture, settings: WildGHandSettings) -> TrainingFrames | None:
    """Read validation frames, which no step sees; None where nothing asks for them or they are few.

    Args:
        training: what may be seen of the capture.
        settings: of the fit.

    Raises:
        BadImage: an image is missing or damaged.
    """
    subject, evidence = settings.subject, settings.evidence
    bends, weighs = subject.enabled and subject.validated, evidence.enabled and evidence.validated
    if not (bends or weighs):
        return None
    frames = load_validation_frames(training, MOST)
    return frames if len(frames) >= LEAST else None
