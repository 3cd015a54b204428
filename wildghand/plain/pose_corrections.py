"""Poses of training frames that are fitted with the hand."""

from __future__ import annotations

import torch

from wildghand.gaussians.training import TrainingClip


class PoseCorrections:
    """Changes that are added to the given poses of R training frames; zeros at first.

    Attributes:
        poses: by side, (R, 16, 3) rad, added to the axis-angle vectors.
        places: by side, (R, 3) m, added to the translations.
    """

    def __init__(self, clip: TrainingClip) -> None:
        self._given = clip.parameters
        self.poses = {side: torch.zeros_like(pose) for side, (pose, _, _) in self._given.items()}
        self.places = {side: torch.zeros_like(place) for side, (_, _, place) in self._given.items()}

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors by name: `pose.SIDE`, `transl.SIDE`."""
        return {
            **{f"pose.{side}": value for side, value in self.poses.items()},
            **{f"transl.{side}": value for side, value in self.places.items()},
        }

    def hands(
        self, rows: torch.Tensor
    ) -> dict[str, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """Corrected pose (B, 16, 3), betas (10,) and translation (B, 3) of (B,) rows, by side."""
        hands = {}
        for side, (pose, betas, transl) in self._given.items():
            place = transl[rows] + self.places[side][rows]
            hands[side] = pose[rows] + self.poses[side][rows], betas, place
        return hands
