"""How far evidence and the skin around a place act, chosen by validation frames.

Where a person's hand is far from the hand model, offsets from the skin are the person's and not
errors of depth, and evidence takes away what is right. Where a palm has another colour than the
back, as that of a glove, the back says nothing of it. Nothing in the training frames tells: they
are drawn without evidence, and show other places.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hwp_bench.base.arrays import evenly
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
from wildghand.gaussians.training import TrainingClip
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import WildGHandSettings

# Most training frames in which gaps are looked for.
_FRAMES = 12
# Coverage that discs may take from a pixel without a gap, and the share of what a Gaussian draws
# that lies in gaps from which on it is spared.
_GAP, _SPARED = 0.1, 0.01
# All Gaussians stay as they were learnt, and a wrist has no wall, where that lowers the error of
# validation frames by these shares. The first is large: discs also close what no frame shows, which
# validation frames, taken from where the camera stood, do not show either.
_AS_LEARNT, _IN_THE_WAY = 0.1, 0.01


@dataclass(frozen=True, eq=False)
class Gaps:
    """Where discs on the skin leave open what training frames show of the hand.

    A hand model that does not reach the mask, as in the web of a thumb, has no skin there.
    Gaussians that left the skin to close such a place are right, however few frames show them.
    """

    #: What is drawn; its evidence is put back.
    model: WildGHandModel
    #: Hands and cameras of the training frames.
    clip: TrainingClip
    #: Takes (1,) rows and gives (1, H, W), how much each pixel says of the hand, in [0, 1].
    visible: Callable[[Tensor], Tensor]
    #: Training frames.
    count: int

    def closers(self, evidence: Evidence) -> dict[str, Tensor]:
        """Find the Gaussians that close what evidence would open.

        Args:
            evidence: the strongest that may be drawn by.

        Returns:
            (N,) bool by side.
        """
        drawn = self._nothing()
        for row in evenly(self.count, _FRAMES).tolist():
            self._add(drawn, row, evidence)
        return {side: sums[:, 0] > _SPARED * sums[:, 1] for side, sums in drawn.items()}

    def seconds(self, evidence: Evidence) -> float:
        """Return about how long `closers` takes; nothing of the model changes."""
        begun = time.perf_counter()
        self._add(self._nothing(), 0, evidence)
        return min(self.count, _FRAMES) * (time.perf_counter() - begun)

    def _nothing(self) -> dict[str, Tensor]:
        """(N, 2) by side: what each Gaussian draws in gaps and in all, px."""
        zeros = self.model.log_gains.new_zeros
        return {side: zeros(len(rig), 2) for side, rig in self.model.rigs.items()}

    def _add(self, drawn: Mapping[str, Tensor], row: int, evidence: Evidence) -> None:
        """Add what each Gaussian draws in a frame."""
        rows = torch.tensor([row])
        visible = self.visible(rows)
        colors, image, closed = self._draw(rows, visible.shape, None)
        with torch.no_grad():
            left = self._draw(rows, visible.shape, evidence)[-1]
            opened = (closed - left - _GAP).clamp(min=0.0)[..., 0] * visible
        # What a Gaussian weighs in a pixel is the slope of the pixel by the Gaussian's colour.
        pixels = (opened * image[..., 0] + image[..., 1]).sum()
        slopes = torch.autograd.grad(pixels, list(colors.values()))
        for side, slope in zip(colors, slopes, strict=True):
            drawn[side].add_(slope[0, :, :2])

    def _draw(
        self, rows: Tensor, shape: torch.Size, evidence: Evidence | None
    ) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Draw a frame free of perturbations: colours by side, image and coverage."""
        model, here = self.model, rows.to(self.model.log_gains.device)
        colors, found, before = {}, {}, model.evidence
        model.evidence = evidence
        try:
            for side, (pose, betas, transl) in self.clip.parameters.items():
                with torch.no_grad():
                    made, hand = model.gaussians(side, pose[here], betas, transl[here])
                colors[side] = made.colors.detach().clone().requires_grad_()
                found[side] = replace(made, colors=colors[side]), hand
        finally:
            model.evidence = before
        size = shape[-1], shape[-2]
        image, coverage = model.rasterize(
            found, self.clip.viewmats[here], self.clip.Ks[here], *size
        )
        return colors, image, coverage.detach()


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
    #: What discs would leave open.
    gaps: Gaps

    @property
    def drawings(self) -> JudgedDrawings | None:
        """The validation frames that judge; None also where nothing is chosen."""
        evidence = self.settings.evidence
        return self.judges if evidence.enabled and evidence.validated else None

    def best(self) -> list[Evidence | ColorChanges]:
        """What draws validation frames best; without what is the model's own already.

        Where nothing is judged, that is evidence and fill by the settings' own shares. In each case
        Gaussians that close gaps are spared.
        """
        if not self.settings.evidence.enabled:
            return []
        several = self.candidates()
        if self.drawings is None:
            evidence, (colors,) = several[0], self.filled.carried_on(self._fills[:1])
        else:
            evidence, colors = self._judged(self.drawings, several)
        found: list[Evidence | ColorChanges] = []
        if not evidence.equals(self.model.evidence):
            found.append(evidence)
        if colors is not None and colors is not self.model.color_changes:
            found.append(colors)
        return found

    def candidates(self) -> list[Evidence]:
        """The strengths, the settings' own first; Gaussians that close gaps are spared in each."""
        closers = self.gaps.closers(self._strongest)
        return [self._evidence(each).spare(closers) for each in self._strengths]

    def _judged(
        self, drawings: JudgedDrawings, several: Sequence[Evidence]
    ) -> tuple[Evidence, ColorChanges | None]:
        """One evidence of several, and with it the changes of colours."""
        predicted = drawings.predict_all()
        changes = self.model.color_changes
        errors = [drawings.error(predicted, each, changes) for each in several]
        least = min(errors)
        # Of equal ones the first is taken, which is the settings' own.
        best = several[errors.index(least)]
        opened = frozenset(self.model.rigs)
        for other, share in (
            (replace(best, open_wrists=opened), _IN_THE_WAY),
            (best.spare_all(), _AS_LEARNT),
            (replace(best.spare_all(), open_wrists=opened), _AS_LEARNT),
        ):
            error = drawings.error(predicted, other, changes)
            if error < (1.0 - share) * least:
                best, least = other, error
        if self.model.light is not None:
            fills = self.filled.carried_on(self._fills)
            changes = min(fills, key=lambda each: drawings.error(predicted, best, each))
        return best, changes

    def seconds(self) -> float:
        """Return about how long `best` takes; nothing of the model changes."""
        if not self.settings.evidence.enabled:
            return 0.0
        gaps = self.gaps.seconds(self._strongest)
        return gaps + self._seconds_of_drawings() + self._seconds_of_fills()

    def _seconds_of_drawings(self) -> float:
        drawings = self.drawings
        if drawings is None:
            return 0.0
        took = drawings.seconds
        # With a light, which there is at the end alone, the network is asked twice.
        each = (2.0 if self.settings.light.enabled else 1.0) * took.predict
        # Besides the strengths, three more without a wall or discs.
        each += (len(self._strengths) + 3 + len(self._fills)) * took.draw
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

    @property
    def _strongest(self) -> Evidence:
        """What opens the most."""
        return self._evidence(max(self._strengths, key=lambda each: each.offset_share))

    def _evidence(self, settings: EvidenceSettings) -> Evidence:
        return weigh_evidence(self.shown, self.frame_count, settings)
