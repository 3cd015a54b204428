"""Training frames that a budget in seconds has room for."""

from __future__ import annotations

from hwp_bench.methods.contract import Budget, TrainingCapture
from wildghand.model.settings import WildGHandSettings

# Fewer say too little of a person, whatever the budget.
_LEAST = 16


def affordable(
    training: TrainingCapture, settings: WildGHandSettings, budget: Budget
) -> TrainingCapture:
    """Leave training frames out where judging all of them would take the budget away from steps.

    Before the first step every frame is loaded, judged, compared with the person's outline and
    counted as evidence: some 0.06 seconds for a frame of 256 px on one core. A clip of a thousand
    frames would spend a minute on that.

    Args:
        training: what may be seen of the capture.
        settings: of the fit.
        budget: of the fit; without seconds all frames are taken.
    """
    share = settings.schedule.frames_per_second
    if budget.seconds is None or not share:
        return training
    return training.thinned(max(_LEAST, int(share * budget.seconds)))
