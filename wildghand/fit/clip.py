"""The hands and cameras of the training frames, ready to be rendered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from hwp_bench.methods.request import TrainingCapture
from wildghand.rig import AnchorPoses, HandRig

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
        self._hands = {
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
        self._cache: AnchorPoses | None = None
        if size <= cache_bytes:
            self._cache = self._pose(torch.arange(len(indices), device=device))

    def poses(self, rows: torch.Tensor) -> AnchorPoses:
        """The anchors of all hands in a batch.

        Args:
            rows: (B,) int64 positions in `indices`.
        """
        if self._cache is None:
            return self._pose(rows)
        return AnchorPoses(self._cache.positions[rows], self._cache.orientations[rows])

    def _pose(self, rows: torch.Tensor) -> AnchorPoses:
        posed = []
        for side, rig in self._rigs.items():
            pose, betas, transl = self._hands[side]
            posed.append(rig.pose(pose[rows], betas, transl[rows]))
        return join_hands(posed)


def join_hands(hands: list[AnchorPoses]) -> AnchorPoses:
    """The anchors of several hands as those of one."""
    if len(hands) == 1:
        return hands[0]
    return AnchorPoses(
        torch.cat([hand.positions for hand in hands], dim=1),
        torch.cat([hand.orientations for hand in hands], dim=1),
    )
