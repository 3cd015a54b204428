"""Colours that a hand takes from the other one, where frames have shown that one alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from torch import Tensor

from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.kept_tensors import kept_tensor

_PREFIX = "other_hand_"
# Largest change of a colour that is read, in logits.
_LARGEST = 20.0


@dataclass(frozen=True, eq=False)
class OtherHand:
    """Changes of the colours of Gaussians, in logits of sRGB."""

    #: (N, 3) by side, of two hands.
    changes: Mapping[str, Tensor]

    def color(self, side: str, raw: RawAttributes) -> RawAttributes:
        """Gaussians in the colours of both hands.

        Args:
            side: which hand.
            raw: (..., N, k) attributes.
        """
        return replace(raw, logit_colors=raw.logit_colors + self.changes[side])

    def to_tensors(self) -> dict[str, Tensor]:
        """The changes by the names under which an avatar keeps them."""
        return {f"{_PREFIX}{side}": change for side, change in self.changes.items()}

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], counts: Mapping[str, int], where: str
    ) -> OtherHand | None:
        """Read what `to_tensors` made.

        Args:
            tensors: of an avatar.
            counts: N by side.
            where: the file, for messages.

        Returns:
            The changes; None where the avatar keeps none.

        Raises:
            BadInput: a part is missing, of another shape, or no change of a colour.
        """
        if not any(f"{_PREFIX}{side}" in tensors for side in counts):
            return None
        bounds = (-_LARGEST, _LARGEST)
        return cls(
            {
                side: kept_tensor(tensors, f"{_PREFIX}{side}", (count, 3), bounds, where).float()
                for side, count in counts.items()
            }
        )
