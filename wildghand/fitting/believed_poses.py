"""The capture of a fit in the poses that it believes in, before anything else is done."""

from __future__ import annotations

from collections.abc import Mapping

from hwp_bench.hands import HandTemplate
from hwp_bench.methods.contract import TrainingCapture
from wildghand.poses import ClipPoses, PoseSettings, believed_hands


def in_believed_poses(
    training: TrainingCapture, templates: Mapping[str, HandTemplate], settings: PoseSettings
) -> tuple[TrainingCapture, ClipPoses | None]:
    """Correct the given poses of a capture, those of the frames to predict too.

    Args:
        training: what may be seen of it.
        templates: by side.
        settings: how poses are corrected.

    Returns:
        The capture with these hands; and what an avatar remembers of it, so that it draws the same
        hands where it is given the capture's: None where nothing was corrected.
    """
    if not settings.enabled:
        return training, None
    believed = believed_hands(templates, training.hands, training.cameras, settings)
    remembered = ClipPoses.of(training.hands, believed)
    return (training if remembered is None else training.with_hands(believed)), remembered
