"""The entry point of the fit with appearances."""

from __future__ import annotations

from typing import ClassVar

from wild_fit.recipe import WildRecipe
from wild_fit.settings import WildSettings
from wildghand.plain.method import RecipeMethod


class WildMethod(RecipeMethod):
    """The plain fit with an appearance and an uncertainty of each training frame."""

    name: ClassVar[str] = "baselines/wild"
    settings_type: ClassVar[type[WildSettings]] = WildSettings
    recipe_type: ClassVar[type[WildRecipe]] = WildRecipe
