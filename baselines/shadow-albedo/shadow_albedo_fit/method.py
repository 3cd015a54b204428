"""The fit with shadows as the benchmark runs it."""

from __future__ import annotations

from typing import Any, ClassVar

from shadow_albedo_fit.recipe import ShadowRecipe
from shadow_albedo_fit.settings import ShadowSettings
from wildghand.plain.method import RecipeMethod
from wildghand.plain.recipe import PlainRecipe
from wildghand.plain.settings import FitSettings


class ShadowMethod(RecipeMethod):
    """The plain fit under one lamp that casts shadows; see `ShadowRecipe`."""

    name: ClassVar[str] = "baselines/shadow-albedo"
    settings_type: ClassVar[type[FitSettings]] = ShadowSettings
    recipe_type: ClassVar[type[PlainRecipe[Any]]] = ShadowRecipe
