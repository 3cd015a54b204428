"""The fit with occluders as the benchmark runs it."""

from __future__ import annotations

from typing import Any, ClassVar

from occluder_splats_fit.recipe import OccluderRecipe
from occluder_splats_fit.settings import OccluderSettings
from wildghand.plain.method import RecipeMethod
from wildghand.plain.recipe import PlainRecipe
from wildghand.plain.settings import FitSettings


class OccluderMethod(RecipeMethod):
    """The plain fit behind occluders of each frame's own; see `OccluderRecipe`."""

    name: ClassVar[str] = "baselines/occluder-splats"
    settings_type: ClassVar[type[FitSettings]] = OccluderSettings
    recipe_type: ClassVar[type[PlainRecipe[Any]]] = OccluderRecipe
