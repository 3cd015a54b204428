"""Shape."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.methods.settings import number
from wildghand.gaussians.found import Found, Kept


@dataclass(frozen=True)
class SubjectSettings:
    """How the template is bent to the person before a fit."""

    #: Bend the template to the masks of the clip.
    enabled: bool = True
    #: Frames that are compared at most, evenly spread over the clip.
    frames: int = number(24, 1, 1000)
    #: Control points on the hand.
    nodes: int = number(200, 20, 1000)
    #: Rounds; in each the silhouettes are drawn again.
    rounds: int = number(2, 1, 100)
    #: Points of all outlines together that are compared in a round.
    points: int = number(3000, 100, 100_000)
    #: Distance at which a point of the outline counts a quarter in the last round, px; three times
    #: as far in the first.
    reach: float = number(1.5, 0.1, 100.0)
    #: Expected error of a point of the outline, px; as large as neighbouring points and frames,
    #: which err together, make it.
    noise: float = number(1.5, 0.01, 1000.0)
    #: Expected change of the length of a bone, or of a side of the palm, relative to the template.
    length_spread: float = number(0.1, 1e-6, 1.0)
    #: Expected change of the thickness of a finger's segment.
    thickness_spread: float = number(0.15, 1e-6, 1.0)
    #: Expected displacement of a control point, m.
    spread: float = number(4e-3, 1e-5, 0.1)
    #: Expected difference between control points 1 cm apart, m.
    roughness: float = number(1e-3, 1e-6, 0.1)
    #: Expected distance of a joint from where its surroundings take it, m.
    joint_spread: float = number(2e-3, 1e-6, 0.1)
    #: Expected error of the given translation of a hand in a frame, m.
    transl_spread: float = number(2e-3, 1e-6, 0.1)
    #: Let frames that are not compared choose how far the hand bends: validation frames, or
    #: training frames where there are fewer than four of those. Else the hand is rather stiff.
    validated: bool = True
    #: Share of the template's misfit in those frames by which a softer hand must be better.
    least_gain: float = number(0.04, 0.0, 1.0)


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
