"""Changes of colours in free poses: what the other hand and the skin around a place say of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from torch import Tensor

from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.kept_tensors import kept_tensor

_PREFIX = "color_changes_"
# Of avatars from before places that are seldom seen took the colours around them.
_FORMER = "other_hand_"
# Largest change of a colour that is read, in logits.
_LARGEST = 20.0


@dataclass(frozen=True, eq=False)
class ColorChanges:
    """Changes of the colours of Gaussians, in logits of sRGB."""

    #: (N, 3) by side.
    changes: Mapping[str, Tensor]

    def color(self, side: str, raw: RawAttributes) -> RawAttributes:
        """Gaussians in their changed colours.

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
    ) -> ColorChanges | None:
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


def rename_former(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of an avatar by their names of today."""
    return {
        _PREFIX + name.removeprefix(_FORMER) if name.startswith(_FORMER) else name: value
        for name, value in tensors.items()
    }
