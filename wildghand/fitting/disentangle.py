"""DPD in a fit: biases of frames, which some steps leave out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from wildghand.dpd.dpd import draw_kept
from wildghand.dpd.temporal import TemporalTarget
from wildghand.fitting.fit import Component, DrawOptions, Fit, FrameTarget, StepBatch
from wildghand.fitting.judging import Prepass
from wildghand.gaussians.training import upload
from wildghand.model import terms
from wildghand.model.frames import RenderedFrames


class Dpd(Component):
    """Perturbations are explained as biases, which are left out of some steps.

    Attributes:
        temporal: what holds the temporal weights; None: nothing.
        drop: (R,) chance that a frame's biases are left out of a step.
    """

    drop: Tensor

    def before(self, fit: Fit) -> None:
        """Bring temporal weights to what the pre-pass found."""
        self._generator = torch.Generator().manual_seed(fit.seed)
        settings = fit.settings.dpd
        self.temporal: TemporalTarget | None = None
        self.drop = torch.full((len(fit.data.frames),), settings.omega_dropout)
        prepass = fit.part(Prepass)
        if prepass is not None and settings.additions:
            self.drop = torch.from_numpy(prepass.assessment.omega_dropout).float()
            self.temporal = TemporalTarget.judged(
                fit.data.judgement.frame_weights.to(fit.device),
                settings.omega_scale,
                fit.settings.prepass.weight_floor,
            )
            self.temporal.begin(fit.model.biases)

    def draws(self, fit: Fit, batch: StepBatch) -> DrawOptions:
        """Which frames of a batch keep their biases in this step, (B,) bool by side."""
        if not batch.stepping:
            return {}
        # A frame is perturbed as a whole: what one hand left out, the other would still explain.
        kept = upload(draw_kept(self.drop[batch.rows], self._generator), fit.device)
        return {"kept": dict.fromkeys(fit.model.perturbation, kept[batch.part])}

    def loss(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> Iterable[Tensor]:
        """Hold the temporal weights, and the gains of clean frames."""
        settings, model, rows = fit.settings.dpd, fit.model, batch.mine
        if self.temporal is not None and settings.omega_weight:
            held = self.temporal.temporal_loss(model.biases, int(rows[0]))
            yield settings.omega_weight * held
        if settings.additions:
            gains = model.log_gains[upload(rows, fit.device)]
            clean = upload(fit.data.judgement.clean[rows], fit.device)
            yield settings.gain_weight * terms.gain_of_clean(gains, clean)
            yield settings.tint_weight * terms.tint_of_gains(gains)

    @torch.no_grad()
    def record(self, fit: Fit, *, final: bool) -> dict[str, Any]:
        """The temporal weights of all frames, by side, at the end."""
        if not final:
            return {}
        rows = torch.arange(len(fit.data.frames), device=fit.device)
        model = fit.model
        return {
            "temporal": {
                side: model.biases_of(side).temporal(rows).omega.tolist()
                for side in model.perturbation
            }
        }

    def state_dict(self) -> dict[str, Any]:
        """See `Component`."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Component`."""
        self._generator.set_state(state["generator"].cpu())
