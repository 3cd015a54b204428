"""The fit in a space of textures as the benchmark runs it."""

from __future__ import annotations

from typing import ClassVar

from texture_space_fit.recipe import SpaceRecipe
from texture_space_fit.settings import SpaceSettings
from wildghand.plain.method import RecipeMethod


class SpaceMethod(RecipeMethod):
    """See `texture_space_fit.recipe.SpaceRecipe` for all that it does."""

    name: ClassVar[str] = "baselines/texture-space"
    settings_type = SpaceSettings
    recipe_type = SpaceRecipe
