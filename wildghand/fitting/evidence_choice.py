"""How far evidence and the skin around a place act, chosen by validation frames.

Where a person's hand is far from the hand model, offsets from the skin are the person's and not
errors of depth, and evidence takes away what is right. Where a palm has another colour than the
back, as that of a glove, the back says nothing of it. Nothing in the training frames tells: they
are drawn without evidence, and show other places.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from wildghand.evidence import (
    ColorChanges,
    Evidence,
    EvidenceSettings,
    fill_shares,
    strengths,
    weigh_evidence,
)
from wildghand.fitting.filled_colors import FilledColors
from wildghand.fitting.judged_drawings import JudgedDrawings
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import WildGHandSettings


@dataclass(frozen=True, eq=False)
class EvidenceChoice:
    """The choice of the strength of evidence, and of colours, at the end of a fit."""

    #: What is drawn; its evidence and colours are put back.
    model: WildGHandModel
    #: Of the fit.
    settings: WildGHandSettings
    #: (N,) by side, how many training frames show each Gaussian.
    shown: Mapping[str, Tensor]
    #: Training frames that are fitted.
    frame_count: int
    #: Validation frames; None where they are too few, or judge nothing.
    judges: JudgedDrawings | None
    #: The colours of places that few frames have shown.
    filled: FilledColors

    @property
    def drawings(self) -> JudgedDrawings | None:
        """The validation frames that judge; None also where nothing is chosen."""
        evidence = self.settings.evidence
        return self.judges if evidence.enabled and evidence.validated else None

    def best(self) -> list[Evidence | ColorChanges]:
        """What draws validation frames best; without what is the model's own already.

        Where nothing is judged, that is the fill by the settings' own share.
        """
        if not self.settings.evidence.enabled:
            return []
        if self.drawings is None:
            evidence, (colors,) = None, self.filled.carried_on(self._fills[:1])
        else:
            evidence, colors = self._judged(self.drawings)
        found: list[Evidence | ColorChanges] = [] if evidence is None else [evidence]
        if colors is not None and colors is not self.model.color_changes:
            found.append(colors)
        return found

    def _judged(self, drawings: JudgedDrawings) -> tuple[Evidence | None, ColorChanges | None]:
        """The evidence, None where it is the model's own, and with it the changes of colours."""
        predicted = drawings.predict_all()
        changes = self.model.color_changes
        several = [self._evidence(index) for index in range(len(self._strengths))]
        # Of equal ones min takes the first, which is the settings' own.
        best = min(several, key=lambda each: drawings.error(predicted, each, changes))
        if self.model.light is not None:
            fills = self.filled.carried_on(self._fills)
            changes = min(fills, key=lambda each: drawings.error(predicted, best, each))
        return None if best is several[0] else best, changes

    def seconds(self) -> float:
        """Return about how long `best` takes; nothing of the model changes."""
        if not self.settings.evidence.enabled:
            return 0.0
        return self._seconds_of_drawings() + self._seconds_of_fills()

    def _seconds_of_drawings(self) -> float:
        drawings = self.drawings
        if drawings is None:
            return 0.0
        took = drawings.seconds
        # With a light, which there is at the end alone, the network is asked twice.
        each = (2.0 if self.settings.light.enabled else 1.0) * took.predict
        each += (len(self._strengths) + len(self._fills)) * took.draw
        return took.features + each * len(drawings.frames)

    def _seconds_of_fills(self) -> float:
        """About how long the fills take; without a light there are none."""
        if not self.settings.light.enabled:
            return 0.0
        begun = time.perf_counter()
        self.filled.rehearse()
        return (time.perf_counter() - begun) * sum(share > 0.0 for share in self._fills)

    @functools.cached_property
    def _strengths(self) -> list[EvidenceSettings]:
        return strengths(self.settings.evidence)

    @functools.cached_property
    def _fills(self) -> list[float]:
        return fill_shares(self.settings.evidence)

    def _evidence(self, index: int) -> Evidence:
        return weigh_evidence(self.shown, self.frame_count, self._strengths[index])
