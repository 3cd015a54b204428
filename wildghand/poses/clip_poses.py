"""The poses of a clip, given and believed, as an avatar remembers them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from hwp_bench.hands import HandParameters, HandPose
from wildghand.gaussians.found import Found, Kept

# Largest number that is read, as in a capture, rad or m.
_LARGEST = 1e6
_Tables = Annotated[Mapping[str, np.ndarray], Kept(("F", 51), -_LARGEST, _LARGEST)]


@dataclass(frozen=True, eq=False)
class ClipPoses(Found):
    """Poses of the frames of a clip by side, (F, 51) float32: 16 axis-angle vectors and transl.

    A pose that was given by an estimator is told by its numbers, all of them: no other pose is
    changed.
    """

    prefix = "poses_"
    given: _Tables
    believed: _Tables

    @functools.cached_property
    def _rows(self) -> dict[str, dict[bytes, int]]:
        """The row of each given pose, by side."""
        return {
            side: {row.tobytes(): number for number, row in enumerate(poses)}
            for side, poses in self.given.items()
        }

    @classmethod
    def of(
        cls, given: Mapping[str, HandParameters], believed: Mapping[str, HandParameters]
    ) -> ClipPoses | None:
        """Compare given and believed hands; None where all are the same."""
        changed = [side for side in given if believed[side] is not given[side]]
        if not changed:
            return None
        return cls(
            {side: _numbers(given[side].pose, given[side].transl) for side in changed},
            {side: _numbers(believed[side].pose, believed[side].transl) for side in changed},
        )

    def corrected(self, hands: Mapping[str, HandPose]) -> dict[str, HandPose]:
        """The hands; one in a pose that the clip gave is in the pose that is believed."""
        return {side: self._corrected(side, hand) for side, hand in hands.items()}

    def _corrected(self, side: str, hand: HandPose) -> HandPose:
        numbers = _numbers(hand.pose[None], hand.transl[None])[0]
        row = self._rows.get(side, {}).get(numbers.tobytes())
        if row is None:
            return hand
        numbers = self.believed[side][row].astype(np.float64)
        return replace(hand, pose=numbers[:48].reshape(16, 3), transl=numbers[48:])


def _numbers(pose: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Poses (F, 16, 3) and translations (F, 3) as rows of float32, without negative zeros."""
    rows = np.concatenate([pose.reshape(len(pose), -1), transl], axis=1)
    return rows.astype(np.float32) + np.float32(0.0)
