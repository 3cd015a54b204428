"""The fit to exposures as the benchmark runs it."""

from __future__ import annotations

from typing import Any, ClassVar

from exposure_fit.recipe import ExposureRecipe
from exposure_fit.settings import ExposureSettings
from wildghand.plain.method import RecipeMethod
from wildghand.plain.recipe import PlainRecipe
from wildghand.plain.settings import FitSettings


class ExposureMethod(RecipeMethod):
    """The plain fit to frames that are means over a motion; see `ExposureRecipe`."""

    name: ClassVar[str] = "baselines/exposure"
    settings_type: ClassVar[type[FitSettings]] = ExposureSettings
    recipe_type: ClassVar[type[PlainRecipe[Any]]] = ExposureRecipe
