"""Gaussians that few frames have shown: discs on the skin, where validation frames agree.

Those that no frame shows are drawn as discs from directions in which the camera never stood, in the
colours of the skin around them. From behind, where they shine through visible skin, they keep their
learnt shape.

If a person's hand differs much from the hand model, offsets from the skin are real and not errors
of depth, and visibility would remove them. If the palm has another colour than the back, as with
some gloves, the back does not predict it. Training frames cannot decide this, because they show
other places; validation frames do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hwp_bench.base.arrays import evenly
from wildghand.fitting.choice import JudgedDrawings, ValidationFrames
from wildghand.fitting.colors import FilledColors, neighbours
from wildghand.fitting.fit import Component, Fit
from wildghand.gaussians.training import TrainingClip
from wildghand.model.model import WildGHandModel
from wildghand.plain.choice import choose
from wildghand.visibility import (
    ColorChanges,
    Visibility,
    VisibilitySettings,
    fill_shares,
    never_shown,
    shown_frames,
    strengths,
    weigh_visibility,
)

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

    #: What is drawn; its visibility is put back.
    model: WildGHandModel
    #: Hands and cameras of the training frames.
    clip: TrainingClip
    #: Takes (1,) rows and gives (1, H, W), how much each pixel says of the hand, in [0, 1].
    visible: Callable[[Tensor], Tensor]
    #: Training frames.
    count: int

    def closers(self, visibility: Visibility) -> dict[str, Tensor]:
        """Find the Gaussians that close what visibility would open.

        Returns:
            (N,) bool by side.
        """
        drawn = self._nothing()
        for row in evenly(self.count, _FRAMES).tolist():
            self._add(drawn, row, visibility)
        return {side: sums[:, 0] > _SPARED * sums[:, 1] for side, sums in drawn.items()}

    def seconds(self, visibility: Visibility) -> float:
        """Return about how long `closers` takes; nothing of the model changes."""
        begun = time.perf_counter()
        self._add(self._nothing(), 0, visibility)
        return min(self.count, _FRAMES) * (time.perf_counter() - begun)

    def _nothing(self) -> dict[str, Tensor]:
        """(N, 2) by side: what each Gaussian draws in gaps and in all, px."""
        zeros = self.model.log_gains.new_zeros
        return {side: zeros(len(rig), 2) for side, rig in self.model.rigs.items()}

    def _add(self, drawn: Mapping[str, Tensor], row: int, visibility: Visibility) -> None:
        """Add what each Gaussian draws in a frame."""
        rows = torch.tensor([row])
        visible = self.visible(rows)
        colors, image, closed = self._draw(rows, visible.shape, None)
        with torch.no_grad():
            left = self._draw(rows, visible.shape, visibility)[-1]
            opened = (closed - left - _GAP).clamp(min=0.0)[..., 0] * visible
        # What a Gaussian weighs in a pixel is the slope of the pixel by the Gaussian's colour.
        pixels = (opened * image[..., 0] + image[..., 1]).sum()
        slopes = torch.autograd.grad(pixels, list(colors.values()))
        for side, slope in zip(colors, slopes, strict=True):
            drawn[side].add_(slope[0, :, :2])

    def _draw(
        self, rows: Tensor, shape: torch.Size, visibility: Visibility | None
    ) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Draw a frame free of perturbations: colours by side, image and coverage."""
        model, here = self.model, rows.to(self.model.log_gains.device)
        colors, found, before = {}, {}, model.visibility
        model.visibility = visibility
        try:
            for side, (pose, betas, transl) in self.clip.parameters.items():
                with torch.no_grad():
                    given = pose[here], betas, transl[here]
                    dark = model.cast({side: given}).get(side)
                    predicted = model.predict_hand(side, given, None)
                    viewmats = self.clip.viewmats[here]
                    made, hand = model.dressed(side, predicted, dark=dark, viewmats=viewmats)
                colors[side] = made.colors.detach().clone().requires_grad_()
                found[side] = replace(made, colors=colors[side]), hand
        finally:
            model.visibility = before
        size = shape[-1], shape[-2]
        image, coverage = model.rasterize(
            found, self.clip.viewmats[here], self.clip.Ks[here], *size
        )
        return colors, image, coverage.detach()


class FewShown(Component):
    """Visibility counts before the fit; how strongly it acts, and fill, is chosen after it.

    Attributes:
        shown: (N,) by side, how many training frames show each Gaussian.
        unseen: (N,) bool by side, those amid skin that none shows.
        gaps: what discs would leave open.
        filled: the colours of places that few frames have shown.
        judges: validation frames; None where they are too few, or choose nothing.
    """

    shown: Mapping[str, Tensor]
    unseen: Mapping[str, Tensor]
    gaps: Gaps
    filled: FilledColors
    judges: JudgedDrawings | None

    def before(self, fit: Fit) -> None:
        """Count, and let the model keep the visibility of the settings' own strength."""
        data, model, count = fit.data, fit.model, len(fit.data.frames)
        self.shown = shown_frames(model.rigs, fit.clip, data.visible, count)
        self.unseen = {
            side: never_shown(frames, torch.from_numpy(neighbours(model.rigs[side])).to(fit.device))
            for side, frames in self.shown.items()
        }
        model.keep(self._weigh(fit, fit.settings.visibility))
        self.gaps = Gaps(model, fit.clip, data.visible, count)
        self.filled = FilledColors(fit, self.shown, self.unseen)
        frames = fit.part(ValidationFrames)
        self.judges = None if frames is None else frames.drawings

    def after(self, fit: Fit) -> None:
        """Let the model keep what draws validation frames best."""
        for best in self.best(fit):
            fit.model.keep(best)

    def best(self, fit: Fit) -> list[Visibility | ColorChanges]:
        """The choice that draws validation frames best, less what the model already has.

        Where nothing is judged, these are the shares of the settings. In each case
        Gaussians that close gaps are spared.
        """
        several, shares = self.candidates(fit), fill_shares(fit.settings.visibility)
        if self.judges is None:
            visibility, (colors,) = several[0], self.filled.carried_on(shares[:1])
        else:
            visibility, colors = self._judged(fit, self.judges, several)
        found: list[Visibility | ColorChanges] = []
        if not visibility.equals(fit.model.visibility):
            found.append(visibility)
        if colors is not None:
            found.append(colors)
        return found

    def candidates(self, fit: Fit) -> list[Visibility]:
        """The strengths, the settings' own first; Gaussians that close gaps are spared in each."""
        closers = self.gaps.closers(self._strongest(fit))
        return [
            self._weigh(fit, each).spare(closers).without(self.unseen)
            for each in strengths(fit.settings.visibility)
        ]

    def _judged(
        self, fit: Fit, judges: JudgedDrawings, several: Sequence[Visibility]
    ) -> tuple[Visibility, ColorChanges | None]:
        """One visibility of several, and with it the changes of colours."""
        predicted, opened = judges.predict_all(), frozenset(fit.model.rigs)

        def error(visibility: Visibility) -> float:
            return judges.error(predicted, visibility, None)

        # Of equal ones the first is taken, which is the settings' own.
        best, least = choose([(each, 0.0) for each in several], error)
        learnt = best.spare_all().without(self.unseen)
        others = (
            (replace(best, open_wrists=opened), _IN_THE_WAY),
            (learnt, _AS_LEARNT),
            (replace(learnt, open_wrists=opened), _AS_LEARNT),
        )
        best, _ = choose(others, error, (best, least))
        if fit.model.light is None:
            return best, None
        fills = self.filled.carried_on(fill_shares(fit.settings.visibility))
        several_fills = [(each, 0.0) for each in fills]
        colors, _ = choose(several_fills, lambda each: judges.error(predicted, best, each))
        return best, colors

    def seconds(self, fit: Fit) -> float:
        """See `Component`."""
        total = self.gaps.seconds(self._strongest(fit))
        settings, lit = fit.settings.visibility, fit.settings.light.enabled
        fills = fill_shares(settings)
        if self.judges is not None:
            took = self.judges.seconds
            # With a light, which there is at the end alone, the network is asked twice.
            each = (2.0 if lit else 1.0) * took.predict
            # Besides the strengths, three more without a wall or discs.
            each += (len(strengths(settings)) + 3 + len(fills)) * took.draw
            total += took.features + each * len(self.judges.frames)
        if lit:  # without a light nothing is filled
            begun = time.perf_counter()
            self.filled.rehearse()
            total += (time.perf_counter() - begun) * sum(share > 0.0 for share in fills)
        return total

    def _strongest(self, fit: Fit) -> Visibility:
        """Return the strongest visibility of those that are tried."""
        several = strengths(fit.settings.visibility)
        return self._weigh(fit, max(several, key=lambda each: each.offset_share))

    def _weigh(self, fit: Fit, settings: VisibilitySettings) -> Visibility:
        weighed = weigh_visibility(self.shown, len(fit.data.frames), settings)
        return weighed.without(self.unseen)
