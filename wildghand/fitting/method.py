"""WildGHand as an entry of the benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hwp_bench.methods.contract import Budget, Report, TrainingCapture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.fitting.affordable import affordable
from wildghand.fitting.fit import Fit
from wildghand.fitting.optimize import optimize
from wildghand.fitting.ready import ready_fit
from wildghand.model.settings import read_settings
from wildghand.splat.threads import denormals_flushed


class WildGHandMethod:
    """See `hwp_bench.methods.contract.Method`.

    Args:
        settings: any of the fields of `wildghand.model.settings.WildGHandSettings`.
        seed: of anchors, initial weights, order of the frames and dropout; on one machine's CPU
            the same seed and number of steps give the same avatar bit for bit.

    Raises:
        BadMethod: a setting is unknown or out of range.
        MissingDependency: CUDA was asked for and is not there.
    """

    def __init__(self, settings: Mapping[str, Any], seed: int = 0) -> None:
        self.settings = read_settings(settings)
        self.seed = seed
        self.device = ready_fit(self.settings.device)

    @denormals_flushed()
    def fit(self, training: TrainingCapture, budget: Budget, report: Report) -> WildGHandAvatar:
        """Fit an avatar to the training frames (validation frames only choose
        how strongly evidence acts; see `wildghand.fitting.evidence_choice`).

        Args:
            training: what the method may see of the capture.
            budget: when to stop; without steps the settings' number holds.
            report: where checkpoints are offered.

        Raises:
            BadInput: no training frame can be used.
            DidNotConverge: the fit diverged at once.
        """
        training = affordable(training, self.settings, budget)
        return optimize(Fit(training, self.settings, self.seed, self.device), budget, report)
