"""Everything that is measured in one frame before frames are compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wildghand.prepass.cues import Explained


@dataclass(frozen=True, eq=False)
class Look:
    """Everything that was measured in one usable frame."""

    #: The frame under the intensity model.
    explained: Explained
    #: (P,) int32 row-major numbers of the silhouette's pixels.
    pixels: np.ndarray
    #: (B,) int32 row-major numbers of pixels that the mask has and the silhouette lacks.
    beyond: np.ndarray
    #: (P,) int32 cells that the silhouette's pixels show.
    cells: np.ndarray
    #: Share of the hand that the mask lacks.
    hidden: float
    #: `wildghand.prepass.outlines.misplacement`.
    misplacement: float
    #: `wildghand.prepass.edges.border_width`, px; not a number where it cannot be read.
    border: float
    #: Way of the hand since the frame before, px.
    motion: float
