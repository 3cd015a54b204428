"""The subject of a capture: what of a person's hand is fitted before the frames are judged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.training import TrainingFrames
from wildghand.model.settings import WildGHandSettings
from wildghand.subject import SubjectShape, fit_subject
from wildghand.subject.outlines import ComparedFrames


def subject_of(
    training: TrainingCapture,
    frames: TrainingFrames,
    templates: Mapping[str, HandTemplate],
    settings: WildGHandSettings,
    judges: TrainingFrames | None,
) -> SubjectShape | None:
    """Bend the templates to the masks of the frames; None where the settings do not.

    Args:
        training: hands and cameras.
        frames: that are fitted.
        templates: by side.
        settings: of the fit.
        judges: validation frames, which choose how far the hand bends; None where they are too few.
    """
    if not settings.subject.enabled:
        return None

    def compared(some: TrainingFrames) -> ComparedFrames:
        masks = np.asarray(some.masks) > 127
        return ComparedFrames(templates, training.hands, training.cameras, some.indices, masks)

    return fit_subject(
        templates,
        training.hands,
        training.cameras,
        frames.indices,
        np.asarray(frames.masks),
        settings.subject,
        judges=None if judges is None else compared(judges),
    )


def bent_templates(
    templates: Mapping[str, HandTemplate], subject: SubjectShape | None
) -> dict[str, HandTemplate]:
    """The person's hands, by side; the templates where no shape is fitted."""
    if subject is None:
        return dict(templates)
    return {side: subject.applied(template) for side, template in templates.items()}
