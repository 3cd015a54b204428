"""The poses of a clip, given and believed, as an avatar remembers them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from hwp_bench.base.errors import BadInput
from hwp_bench.hands import HandParameters, HandPose

# Names under which an avatar keeps them, before the side.
_GIVEN, _BELIEVED = "poses_given_", "poses_believed_"
# Pose and translation of a hand.
_NUMBERS = 51


@dataclass(frozen=True, eq=False)
class ClipPoses:
    """Poses of the frames of a clip by side, (F, 51) float32: 16 axis-angle vectors and transl.

    A pose that was given by an estimator is told by its numbers, all of them: no other pose is
    changed.
    """

    given: Mapping[str, np.ndarray]
    believed: Mapping[str, np.ndarray]

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

    def to_tensors(self) -> dict[str, torch.Tensor]:
        """As tensors, by the names under which an avatar keeps them."""
        return {
            f"{name}{side}": torch.from_numpy(poses[side])
            for name, poses in ((_GIVEN, self.given), (_BELIEVED, self.believed))
            for side in poses
        }

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, torch.Tensor], sides: tuple[str, ...], where: str
    ) -> ClipPoses | None:
        """Read what `to_tensors` made; None where an avatar keeps none.

        Raises:
            BadInput: they have the wrong shape.
        """
        found: dict[str, dict[str, np.ndarray]] = {_GIVEN: {}, _BELIEVED: {}}
        for side in sides:
            kept = [tensors.get(f"{name}{side}") for name in found]
            if all(tensor is None for tensor in kept):
                continue
            shapes = {None if tensor is None else tuple(tensor.shape) for tensor in kept}
            if len(shapes) > 1 or not all(shape and shape[1:] == (_NUMBERS,) for shape in shapes):
                raise BadInput(
                    f"and the believed ones are not two tables of {_NUMBERS} numbers a frame",
                    where=where,
                    field=f"{_GIVEN}{side}",
                )
            for name, tensor in zip(found, kept, strict=True):
                assert tensor is not None
                found[name][side] = tensor.float().cpu().numpy()
        return cls(found[_GIVEN], found[_BELIEVED]) if found[_GIVEN] else None


def _numbers(pose: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Poses (F, 16, 3) and translations (F, 3) as rows of float32, without negative zeros."""
    rows = np.concatenate([pose.reshape(len(pose), -1), transl], axis=1)
    return rows.astype(np.float32) + np.float32(0.0)
