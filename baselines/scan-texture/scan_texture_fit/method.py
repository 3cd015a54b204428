"""The scan-texture fit as the benchmark runs it."""

from __future__ import annotations

from typing import ClassVar

from scan_texture_fit.recipe import ScanRecipe
from scan_texture_fit.settings import ScanSettings
from wildghand.plain.method import RecipeMethod


class ScanMethod(RecipeMethod):
    """See `scan_texture_fit.recipe.ScanRecipe` for all that it does."""

    name: ClassVar[str] = "baselines/scan-texture"
    settings_type = ScanSettings
    recipe_type = ScanRecipe
