"""The plain fit to exposures: image = mean over the time that the shutter is open."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.methods.settings import number
from wildghand.gaussians.rig import CHUNK, AnchorPoses
from wildghand.gaussians.training import join_hands
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod


def nearest_turn(pose: np.ndarray, to: np.ndarray) -> np.ndarray:
    """The axis-angle vectors of the same rotations that are nearest to given ones.

    A rotation by t about an axis is one by t - 2 pi too; near half a turn a tracker may jump
    between the two.
    """
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    axis = pose / np.where(angle > 0.0, angle, 1.0)
    candidates = np.stack([pose, pose - 2.0 * math.pi * axis])
    choice = np.linalg.norm(candidates - to, axis=-1, keepdims=True).argmin(axis=0)
    return np.take_along_axis(candidates, choice[None], axis=0)[0]


def velocities(
    values: np.ndarray, valid: np.ndarray, indices: np.ndarray, *, turns: bool = False
) -> np.ndarray:
    """Change of numbers from frame to frame by the difference of the valid neighbours.

    Args:
        values: (F, ..., C) of every frame of a clip.
        valid: (F,) bool.
        indices: (R,) valid frames.
        turns: they are axis-angle vectors, whose jumps by a whole turn are none.

    Returns:
        (R, ..., C) per frame; from one side where the other is missing, 0 where both are.
    """
    last = len(values) - 1
    before = indices - ((indices > 0) & valid[indices - 1])
    after = indices + ((indices < last) & valid[np.minimum(indices + 1, last)])
    first, second = values[before], values[after]
    if turns:
        first, second = (nearest_turn(pose, values[indices]) for pose in (first, second))
    steps = np.maximum(after - before, 1)
    return (second - first) / steps.reshape(-1, *[1] * (values.ndim - 1))


def motion_px(
    start: torch.Tensor, end: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor
) -> torch.Tensor:
    """How far points (B, N, 3) in the world move in the image, (B,) px; 0 behind the camera.

    It is the distance that a twentieth of them exceeds.
    """
    places = []
    for points in (start, end):
        seen = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
        on_image = seen @ Ks.mT
        places.append(on_image[..., :2] / on_image[..., 2:].clamp(min=1e-6))
        places[-1] = torch.where(seen[..., 2:] > 0.0, places[-1], 0.0)
    return (places[1] - places[0]).norm(dim=-1).quantile(0.95, dim=1)


@dataclass(frozen=True)
class ExposureSettings(FitSettings):
    """The plain fit's settings, and those of the exposures."""

    #: Moments of an exposure at which the hand is drawn.
    moments: int = number(5, 2, 64)
    #: How long the shutter is open at the start, as a share of the time between two frames.
    shutter: float = number(0.1, 0.0, 2.0)
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

    def __init__(self, material: FitInputs, settings: ExposureSettings) -> None:
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
