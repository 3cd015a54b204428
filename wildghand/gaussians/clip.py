"""The hands and cameras of the training frames, ready to be rendered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.rig import AnchorPoses, HandRig

#: Most memory that posed anchors are kept in, bytes; longer clips are posed step by step.
CACHE_BYTES = 768 * 1024 * 1024

# A position and a quaternion in float32.
_ANCHOR_BYTES = 4 * (3 + 4)


class TrainingClip:
    """The given parameters of R frames; they are constant, so anchors are posed once.

    Args:
        training: hand parameters and cameras of the capture.
        indices: (R,) the frames of the capture that are fitted.
        rigs: by side.
        device: where the tensors live.
        cache_bytes: most memory for posed anchors.

    Attributes:
        parameters: by side, pose (R, 16, 3), betas (10,) and transl (R, 3).
        viewmats: (R, 4, 4).
        Ks: (R, 3, 3) px.
    """

    def __init__(
        self,
        training: TrainingCapture,
        indices: np.ndarray,
        rigs: Mapping[str, HandRig],
        device: torch.device,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        def tensor(array: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(array, dtype=torch.float32, device=device)

        self._rigs = rigs
        self.parameters = {
            side: (
                tensor(training.hands[side].pose[indices]),
                tensor(training.hands[side].betas),
                tensor(training.hands[side].transl[indices]),
            )
            for side in rigs
        }
        self.viewmats = tensor(training.cameras.viewmats[indices])
        self.Ks = tensor(training.cameras.Ks[indices])
        size = len(indices) * sum(len(rig) for rig in rigs.values()) * _ANCHOR_BYTES
        self._cache: dict[str, AnchorPoses] | None = None
        if size <= cache_bytes:
            rows = torch.arange(len(indices), device=device)
            self._cache = {side: self._pose(side, rows) for side in rigs}

    def hand(self, side: str, rows: torch.Tensor) -> AnchorPoses:
        """The anchors of one hand in a batch, without gradient.

        Args:
            side: which.
            rows: (B,) int64 positions in `indices`.
        """
        if self._cache is None:
            return self._pose(side, rows)
        posed = self._cache[side]
        return AnchorPoses(posed.positions[rows], posed.orientations[rows])

    def poses(self, rows: torch.Tensor) -> AnchorPoses:
        """The anchors of all hands in a batch, one hand after the other."""
        return join_hands([self.hand(side, rows) for side in self._rigs])

    def _pose(self, side: str, rows: torch.Tensor) -> AnchorPoses:
        pose, betas, transl = self.parameters[side]
        return self._rigs[side].pose(pose[rows], betas, transl[rows])


def join_hands(hands: list[AnchorPoses]) -> AnchorPoses:
    """The anchors of several hands as those of one."""
    if len(hands) == 1:
        return hands[0]
    return AnchorPoses(
        torch.cat([hand.positions for hand in hands], dim=1),
        torch.cat([hand.orientations for hand in hands], dim=1),
    )
