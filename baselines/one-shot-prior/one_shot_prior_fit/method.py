"""One-shot-prior: a network that knows other people's hands, frozen, and bent to one person.

In the manner of InterGaussianHand. What it knows comes from the prior that ships with WildGHand.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from one_shot_prior_fit.recipe import OneShotRecipe
from one_shot_prior_fit.settings import OneShotSettings
from wildghand.fitting.ready import ready_fit
from wildghand.plain.method import RecipeMethod


class OneShotMethod(RecipeMethod):
    """See `one_shot_prior_fit.recipe.OneShotRecipe` for all that it does."""

    name: ClassVar[str] = "baselines/one-shot-prior"
    settings_type = OneShotSettings
    recipe_type = OneShotRecipe

    def __init__(self, settings: Mapping[str, Any], seed: int = 0) -> None:
        super().__init__(settings, seed)
        ready_fit(self.settings.device)
