"""The plain fit to exposures: image = mean over the time that the shutter is open."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from exposure_fit.motion import motion_px, velocities
from hwp_bench.methods.settings import number
from wildghand.gaussians.rig import CHUNK, AnchorPoses
from wildghand.gaussians.training import join_hands
from wildghand.plain.recipe import Batch, Drawing, FitSettings, Material, PlainRecipe, RecipeMethod


@dataclass(frozen=True)
class ExposureSettings(FitSettings):
    """The plain fit's settings, and those of the exposures."""

    #: Moments of an exposure at which the hand is drawn.
    moments: int = number(5, 2, 64)
    #: How long the shutter is open at the start, as a share of the time between two frames.
    shutter: float = number(0.25, 0.0, 2.0)
    #: Motion of the hand during the exposure under which a frame is taken for sharp, px.
    least_motion: float = number(1.5, 0.0, 1e6)
    #: Adam step of the two ends' poses, rad.
    pose_rate: float = 1e-4
    #: Adam step of the two ends' places, m.
    transl_rate: float = 1e-5


class ExposureRecipe(PlainRecipe[ExposureSettings]):
    """Two ends of a linear motion in each frame, which are fitted with the hand.

    Attributes:
        ends: by name: `pose.SIDE` (R, 2, 16, 3) rad and `transl.SIDE` (R, 2, 3) m, what is added
            to the given parameters when the shutter opens and when it closes.
        moving: (R,) bool on the CPU, whether a frame is taken for an exposure.
    """

    def __init__(self, material: Material, settings: ExposureSettings) -> None:
        super().__init__(material, settings)
        indices = material.frames.indices
        signs = torch.tensor([-0.5, 0.5]) * settings.shutter
        self.ends: dict[str, torch.Tensor] = {}
        for side in self.model.rigs:
            hand = material.training.hands[side]
            turning = velocities(hand.pose, hand.valid, indices, turns=True)
            going = velocities(hand.transl, hand.valid, indices)
            for name, speed in (("pose", turning), ("transl", going)):
                speeds = torch.as_tensor(speed, dtype=torch.float32)[:, None]
                shape = (1, 2, *[1] * (speeds.dim() - 2))
                self.ends[f"{name}.{side}"] = (signs.view(shape) * speeds).to(material.device)
        self.moving = self._motion() > settings.least_motion

    @torch.no_grad()
    def _motion(self) -> torch.Tensor:
        """(R,) px, how far the hands move in each exposure."""
        made = []
        for rows in torch.arange(len(self.material.frames)).split(CHUNK):
            start, end = (
                self._at(rows, torch.full((len(rows),), moment)).positions for moment in (0.0, 1.0)
            )
            made.append(motion_px(start, end, self.clip.viewmats[rows], self.clip.Ks[rows]).cpu())
        return torch.cat(made)

    def _at(self, rows: torch.Tensor, moments: torch.Tensor) -> AnchorPoses:
        """The anchors of frames (B,) at moments (B,) of their exposures; differentiable.

        The shutter opens at moment 0 and closes at 1.
        """
        hands = []
        moments = moments.to(self.clip.viewmats)
        for side, rig in self.model.rigs.items():
            pose, betas, transl = self.clip.parameters[side]
            turn, move = self.ends[f"pose.{side}"][rows], self.ends[f"transl.{side}"][rows]
            turned = torch.lerp(turn[:, 0], turn[:, 1], moments[:, None, None])
            moved = torch.lerp(move[:, 0], move[:, 1], moments[:, None])
            hands.append(rig.follow(pose[rows] + turned, betas, transl[rows] + moved))
        return join_hands(hands)

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and the ends of the exposures."""
        return {**super().parameters(), **self.ends}

    def draw(self, batch: Batch) -> Drawing:
        """The mean over an exposure for frames that move, one sharp image for the others."""
        if not self.moving[batch.rows].any():
            return super().draw(batch)
        drawn = [
            self._exposed(batch.rows[i : i + 1], bool(self.moving[row]))
            for i, row in enumerate(batch.rows.tolist())
        ]
        return Drawing(
            torch.cat([one.image for one in drawn]), torch.cat([one.coverage for one in drawn])
        )

    def _exposed(self, row: torch.Tensor, moving: bool) -> Drawing:
        """One frame, (1, H, W, C)."""
        training, clip = self.material.training, self.clip
        poses, rows = clip.poses(row), row
        if moving:
            count = self.settings.moments
            rows = row.expand(count)
            poses = self._at(rows, torch.linspace(0.0, 1.0, count))
        image, coverage = self.model.render(
            poses, clip.viewmats[rows], clip.Ks[rows], training.width, training.height
        )
        return Drawing(image.mean(dim=0, keepdim=True), coverage.mean(dim=0, keepdim=True))


class ExposureMethod(RecipeMethod):
    """The plain fit to frames that are means over a motion; see `ExposureRecipe`."""

    name = "baselines/exposure"
    settings_type = ExposureSettings
    recipe_type = ExposureRecipe
