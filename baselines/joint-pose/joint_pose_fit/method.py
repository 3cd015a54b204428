"""The plain fit with a correction of the given pose in each training frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from hwp_bench.methods.settings import number
from wildghand.gaussians.training import join_hands
from wildghand.plain.recipe import Batch, Drawing, FitSettings, Material, PlainRecipe, RecipeMethod


@dataclass(frozen=True)
class JointPoseSettings(FitSettings):
    """Those of the plain fit, and how the corrections are fitted."""

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
    """See `PlainRecipe`. Poses of training frames are fitted; betas and test poses are as given.

    Attributes:
        poses: by side, (R, 16, 3) what is added to the axis-angle vectors of each frame, rad.
        places: by side, (R, 3) what is added to the translations, m.
    """

    def __init__(self, material: Material, settings: JointPoseSettings) -> None:
        super().__init__(material, settings)
        given = self.clip.parameters
        self.poses = {side: torch.zeros_like(pose) for side, (pose, _, _) in given.items()}
        self.places = {side: torch.zeros_like(place) for side, (_, _, place) in given.items()}

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and the corrections of each hand."""
        return {
            **super().parameters(),
            **{f"pose_{side}": value for side, value in self.poses.items()},
            **{f"transl_{side}": value for side, value in self.places.items()},
        }

    def rates(self) -> dict[str, float]:
        """Adam's step at the start of each tensor, by name."""
        return {
            **super().rates(),
            **{f"pose_{side}": self.settings.pose_rate for side in self.poses},
            **{f"transl_{side}": self.settings.transl_rate for side in self.places},
        }

    def draw(self, batch: Batch) -> Drawing:
        """Draw the hands in their corrected poses; differentiable in these."""
        training, clip = self.material.training, self.clip
        rows = batch.rows.to(self.material.device)
        hands = []
        for side, rig in self.model.rigs.items():
            pose, betas, transl = clip.parameters[side]
            corrected = pose[rows] + self.poses[side][rows], transl[rows] + self.places[side][rows]
            hands.append(rig.follow(corrected[0], betas, corrected[1]))
        image, coverage = self.model.render(
            join_hands(hands), clip.viewmats[rows], clip.Ks[rows], training.width, training.height
        )
        return Drawing(image, coverage)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The plain fit's, and the corrections' mean square."""
        loss = super().loss(batch, drawing, weights)
        if self.settings.hold_weight == 0.0:
            return loss
        rows = batch.rows.to(self.material.device)
        squares = [value[rows].square().mean() for value in self.poses.values()]
        squares += [(_DM * value[rows]).square().mean() for value in self.places.values()]
        return loss + self.settings.hold_weight * torch.stack(squares).mean()


class JointPoseMethod(RecipeMethod):
    """The plain fit that also corrects the poses of its training frames."""

    name: ClassVar[str] = "baselines/joint-pose"
    settings_type: ClassVar[type[JointPoseSettings]] = JointPoseSettings
    recipe_type: ClassVar[type[JointPoseRecipe]] = JointPoseRecipe
