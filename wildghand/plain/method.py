"""The entry point of methods that fit the plain model: settings, frames, recipe, loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from hwp_bench.methods.contract import Avatar, Budget, Report, TrainingCapture
from hwp_bench.methods.settings import settings_from
from wildghand.gaussians.fit_loop import ready_device
from wildghand.gaussians.training import load_frames
from wildghand.plain.hooks import Material, Recipe
from wildghand.plain.loop import run_fit
from wildghand.plain.recipe import PlainRecipe
from wildghand.plain.settings import FitSettings, LoopSettings
from wildghand.splat.threads import denormals_flushed


class RecipeMethod:
    """See `hwp_bench.methods.contract.Method`. A method is a subclass that names its parts.

    Args:
        settings: any of the fields of `settings_type`.
        seed: of the anchors and of the order of the frames; on one machine's CPU the same seed
            and number of steps give the same avatar bit for bit.

    Raises:
        BadMethod: a setting is unknown or out of range.
        MissingDependency: CUDA was asked for and is not there.
    """

    #: Name in messages about settings.
    name: ClassVar[str]
    #: The settings' dataclass.
    settings_type: ClassVar[type[LoopSettings]] = FitSettings
    #: The recipe's class.
    recipe_type: ClassVar[type[Recipe[Any]]] = PlainRecipe

    def __init__(self, settings: Mapping[str, Any], seed: int = 0) -> None:
        self.settings = settings_from(self.settings_type, settings, self.name)
        self.seed = seed
        self.device = ready_device(self.settings.device)

    @denormals_flushed()
    def fit(self, training: TrainingCapture, budget: Budget, report: Report) -> Avatar:
        """Fit an avatar to the training frames (the validation frames are left alone).

        Args:
            training: what the method may see of the capture.
            budget: when to stop; without steps the settings' number holds.
            report: where checkpoints are offered.

        Raises:
            BadInput: no training frame can be used.
            DidNotConverge: the fit diverged at once.
        """
        material = Material(training, load_frames(training), self.seed, self.device)
        return run_fit(self.recipe_type(material, self.settings), budget, report)
