"""The plain fit with a correction of the given pose in each training frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from hwp_bench.methods.settings import number
from wildghand.gaussians.training import join_hands
from wildghand.plain.pose_corrections import PoseCorrections
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod


@dataclass(frozen=True)
class JointPoseSettings(FitSettings):
    """Settings of the plain fit, and how the corrections are fitted."""

    #: Adam step of the corrections of joint angles, rad.
    pose_rate: float = 3e-4
    #: Adam step of the corrections of a hand's place, m.
    transl_rate: float = 3e-4
    #: Weight of the corrections' mean square in the loss, angles in rad and places in dm.
    hold_weight: float = number(0.0, 0.0, 1e6)


# Places in the penalty are in dm: a hand is about 1 dm from its wrist to its knuckles, so that a
# turn by 1 rad and a shift by 1 dm move a knuckle equally far.
_DM = 10.0


class JointPoseRecipe(PlainRecipe[JointPoseSettings]):
    """See `PlainRecipe`. Poses of training frames are fitted; betas and test poses are as given."""

    def __init__(self, material: FitInputs, settings: JointPoseSettings) -> None:
        super().__init__(material, settings)
        self.corrections = PoseCorrections(self.clip)

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and the corrections of each hand."""
        return {**super().parameters(), **self.corrections.parameters()}

    def draw(self, batch: Batch) -> Drawing:
        """Draw the hands in their corrected poses; differentiable in these."""
        training, clip = self.material.training, self.clip
        rows = batch.rows.to(self.device)
        hands = self.corrections.hands(rows)
        poses = join_hands([rig.follow(*hands[side]) for side, rig in self.model.rigs.items()])
        image, coverage = self.model.render(
            poses, clip.viewmats[rows], clip.Ks[rows], training.width, training.height
        )
        return Drawing(image, coverage)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The plain fit's, and the corrections' mean square."""
        loss = super().loss(batch, drawing, weights)
        if self.settings.hold_weight == 0.0:
            return loss
        rows, made = batch.rows.to(self.device), self.corrections
        squares = [value[rows].square().mean() for value in made.poses.values()]
        squares += [(_DM * value[rows]).square().mean() for value in made.places.values()]
        return loss + self.settings.hold_weight * torch.stack(squares).mean()


class JointPoseMethod(RecipeMethod):
    """The plain fit that also corrects the poses of its training frames."""

    name = "baselines/joint-pose"
    settings_type = JointPoseSettings
    recipe_type = JointPoseRecipe
