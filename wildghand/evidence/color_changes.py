"""Changes of colours in free poses: what the other hand and the skin around a place say of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

from torch import Tensor

from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.found import Found, Kept

_PREFIX = "color_changes_"
# Of avatars from before places that are seldom seen took the colours around them.
_FORMER = "other_hand_"
# Largest change of a colour that is read, in logits.
_LARGEST = 20.0


@dataclass(frozen=True, eq=False)
class ColorChanges(Found):
    """Changes of the colours of Gaussians, in logits of sRGB."""

    prefix = _PREFIX
    #: (N, 3) by side.
    changes: Annotated[Mapping[str, Tensor], Kept(("N", 3), -_LARGEST, _LARGEST, name="")]

    def color(self, side: str, raw: RawAttributes) -> RawAttributes:
        """Gaussians in their changed colours.

        Args:
            side: which hand.
            raw: (..., N, k) attributes.
        """
        return replace(raw, logit_colors=raw.logit_colors + self.changes[side])


def rename_former(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of an avatar by their names of today."""
    return {
        _PREFIX + name.removeprefix(_FORMER) if name.startswith(_FORMER) else name: value
        for name, value in tensors.items()
    }
