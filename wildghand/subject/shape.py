"""The shape of a person's hand: what the rest surface and joints of a template lack."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from hwp_bench.hands import HandTemplate
from wildghand.gaussians.found import Found, Kept

# Largest displacement that is read, m.
_LARGEST = 0.1


@dataclass(frozen=True, eq=False)
class SubjectShape(Found):
    """How a person's hand differs from the template; of the right hand, the left is its mirror."""

    prefix = "subject_"
    #: (V, 3) m, added to the rest vertices.
    vertices: Annotated[np.ndarray, Kept(("V", 3), -_LARGEST, _LARGEST, dtype=np.float64)]
    #: (16, 3) m, added to the rest joints.
    joints: Annotated[np.ndarray, Kept((16, 3), -_LARGEST, _LARGEST, dtype=np.float64)]

    def applied(self, template: HandTemplate) -> HandTemplate:
        """The person's hand of the template's side; its parameters mean the same."""
        flip = side_flip(template.side)
        return replace(
            template,
            vertices=template.vertices + self.vertices * flip,
            joints=template.joints + self.joints * flip,
        )


def side_flip(side: str) -> np.ndarray:
    """(3,) factors from the right hand's rest frame to that of a side."""
    return np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
