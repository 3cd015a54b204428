"""The choice among the states of a fit, by validation frames, after its last step."""

from __future__ import annotations

from dataclasses import dataclass

from wildghand.fitting.averaging import StepAverage
from wildghand.fitting.earlier_states import EarlierStates
from wildghand.fitting.judged_drawings import JudgedDrawings
from wildghand.model.settings import ScheduleSettings


@dataclass(frozen=True, eq=False)
class StateChoice:
    """States that a fit may go back to, and who judges them."""

    #: Kept along the fit.
    states: EarlierStates
    #: Validation frames; None: the fit ends with its last state.
    judges: JudgedDrawings | None

    @classmethod
    def of(
        cls,
        average: StepAverage,
        frames: int,
        schedule: ScheduleSettings,
        judges: JudgedDrawings | None,
    ) -> StateChoice:
        """As the schedule of a fit says; where nothing judges, no state is kept.

        Args:
            average: the mean of the steps so far.
            frames: that are fitted.
            schedule: of the fit.
            judges: validation frames; None where they are too few.
        """
        if judges is None or not schedule.validated:
            return cls(EarlierStates(average, 0), None)
        return cls(EarlierStates.of_epochs(average, frames, schedule.batch), judges)

    def choose(self) -> int | None:
        """Bring the model to the state that draws the validation frames best.

        Returns:
            Steps behind it, if it is an earlier one than the last.
        """
        return None if self.judges is None else self.states.choose(self.error)

    def error(self) -> float:
        """Mean squared error of the validation frames as the model draws them now.

        Evidence is chosen for the state that is kept, and has no say before.
        """
        assert self.judges is not None
        changes = self.judges.model.color_changes
        return self.judges.error(self.judges.predict_all(), None, changes)

    def seconds(self) -> float:
        """Return about how long `choose` would take now; nothing of the model changes."""
        count = len(self.states.candidates)
        if self.judges is None or not count:
            return 0.0
        took = self.judges.seconds
        each = took.features + (took.predict + took.draw) * len(self.judges.frames)
        return (1 + count) * each
