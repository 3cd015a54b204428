"""The subject of a capture: what of a person's hand is fitted before the frames are judged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.training import TrainingFrames
from wildghand.model.settings import WildGHandSettings
from wildghand.subject import SubjectShape, fit_subject


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
    )


def bent_templates(
    templates: Mapping[str, HandTemplate], subject: SubjectShape | None
) -> dict[str, HandTemplate]:
    """The person's hands, by side; the templates where no shape is fitted."""
    if subject is None:
        return dict(templates)
    return {side: subject.applied(template) for side, template in templates.items()}
