"""The entry point of the fit with corrected poses."""

from __future__ import annotations

from typing import ClassVar

from joint_pose_fit.recipe import JointPoseRecipe
from joint_pose_fit.settings import JointPoseSettings
from wildghand.plain.method import RecipeMethod


class JointPoseMethod(RecipeMethod):
    """The plain fit that also corrects the poses of its training frames."""

    name: ClassVar[str] = "baselines/joint-pose"
    settings_type: ClassVar[type[JointPoseSettings]] = JointPoseSettings
    recipe_type: ClassVar[type[JointPoseRecipe]] = JointPoseRecipe
