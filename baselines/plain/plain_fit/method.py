"""The plain baseline: fit anchored Gaussians to every training frame alike.

It is the non-robust reference that everything else is compared with: no frame is judged, no
residual is weighted down, no pose, shape or exposure is refined. The hand parameters are taken
as they are given.
"""

from __future__ import annotations

from wildghand.plain.recipe import RecipeMethod


class PlainMethod(RecipeMethod):
    """The plain fit as it is; see `wildghand.plain.recipe.PlainRecipe` for all that it does."""

    name = "baselines/plain"
