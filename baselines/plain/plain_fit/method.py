"""The plain baseline: fit anchored Gaussians to every training frame alike.

It is the non-robust reference that everything else is compared with: no frame is judged, no
residual is weighted down, no pose, shape or exposure is refined. The hand parameters are taken
as they are given.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hwp_bench.methods.contract import Budget, Report, TrainingCapture
from plain_fit.model import PlainAvatar, make_model
from plain_fit.optimize import fit_model
from plain_fit.settings import read_settings
from wildghand.gaussians.fit_loop import ready_device
from wildghand.gaussians.training import load_frames
from wildghand.splat.threads import denormals_flushed


class PlainMethod:
    """See `hwp_bench.methods.contract.Method`.

    Args:
        settings: any of the fields of `plain_fit.settings.PlainSettings`.
        seed: of the anchors and of the order of the frames; on one machine's CPU the same seed
            and number of steps give the same avatar bit for bit.

    Raises:
        BadMethod: a setting is unknown or out of range.
        MissingDependency: CUDA was asked for and is not there.
    """

    def __init__(self, settings: Mapping[str, Any], seed: int = 0) -> None:
        self.settings = read_settings(settings)
        self.seed = seed
        self.device = ready_device(self.settings.device)

    @denormals_flushed()
    def fit(self, training: TrainingCapture, budget: Budget, report: Report) -> PlainAvatar:
        """Fit an avatar to the training frames (the validation frames are left alone).

        Args:
            training: what the method may see of the capture.
            budget: when to stop; without steps the settings' number holds.
            report: where checkpoints are offered.

        Raises:
            BadInput: no training frame can be used.
            DidNotConverge: the fit diverged at once.
        """
        frames = load_frames(training)
        model = make_model(
            {side: training.template(side) for side in training.sides},
            frames.mean_color(),
            gaussians=self.settings.gaussians,
            opacity=self.settings.initial_opacity,
            degree=self.settings.shading_degree,
            seed=self.seed,
            device=self.device,
        )
        return fit_model(model, training, frames, self.settings, budget, report, self.seed)
