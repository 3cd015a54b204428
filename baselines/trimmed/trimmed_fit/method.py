"""The entry point of the trimmed fit."""

from __future__ import annotations

from typing import ClassVar

from trimmed_fit.recipe import TrimmedRecipe
from trimmed_fit.settings import TrimmedSettings
from wildghand.plain.method import RecipeMethod


class TrimmedMethod(RecipeMethod):
    """The plain fit without pixels that fit badly."""

    name: ClassVar[str] = "baselines/trimmed"
    settings_type: ClassVar[type[TrimmedSettings]] = TrimmedSettings
    recipe_type: ClassVar[type[TrimmedRecipe]] = TrimmedRecipe
