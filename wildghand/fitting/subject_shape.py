"""The subject of a capture: what of a person's hand is fitted before the frames are judged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.judging_frames import judging_frames
from wildghand.gaussians.training import TrainingFrames
from wildghand.model.settings import WildGHandSettings
from wildghand.subject import SubjectShape, fit_subject
from wildghand.subject.compared_frames import ComparedFrames


def subject_of(
    training: TrainingCapture,
    frames: TrainingFrames,
    templates: Mapping[str, HandTemplate],
    settings: WildGHandSettings,
) -> SubjectShape | None:
    """Bend the templates to the masks of the frames; None where the settings do not."""
    if not settings.subject.enabled:
        return None
    return fit_subject(
        templates,
        training.hands,
        training.cameras,
        frames.indices,
        np.asarray(frames.masks),
        settings.subject,
        judges=_judges(training, templates) if settings.subject.validated else None,
    )


def _judges(
    training: TrainingCapture, templates: Mapping[str, HandTemplate]
) -> ComparedFrames | None:
    """The validation frames that judge a shape; None where they are too few."""
    frames = judging_frames(training)
    if frames is None:
        return None
    masks = np.asarray(frames.masks) > 127
    return ComparedFrames(templates, training.hands, training.cameras, frames.indices, masks)


def bent_templates(
    templates: Mapping[str, HandTemplate], subject: SubjectShape | None
) -> dict[str, HandTemplate]:
    """The person's hands, by side; the templates where no shape is fitted."""
    if subject is None:
        return dict(templates)
    return {side: subject.applied(template) for side, template in templates.items()}
