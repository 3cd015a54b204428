"""The validation frames that choose what training frames cannot tell."""

from __future__ import annotations

from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.training import TrainingFrames, load_validation_frames
from wildghand.model.settings import WildGHandSettings
from wildghand.subject.fit_subject import LEAST_CHOOSING, MOST_CHOOSING


def judging_frames(training: TrainingCapture, settings: WildGHandSettings) -> TrainingFrames | None:
    """Read validation frames, which no step sees; None where nothing asks for them or they are few.

    Args:
        training: what may be seen of the capture.
        settings: of the fit.

    Raises:
        BadImage: an image is missing or damaged.
    """
    parts = (settings.prepass, settings.subject, settings.evidence)
    asked = any(part.enabled and part.validated for part in parts)
    if not (asked or settings.schedule.validated):
        return None
    frames = load_validation_frames(training, MOST_CHOOSING)
    return frames if len(frames) >= LEAST_CHOOSING else None
