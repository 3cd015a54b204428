"""A predicted frame and its truth, which corrections compare."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.metrics.pixels import squared_error

if TYPE_CHECKING:
    from hwp_bench.evaluation.budget.surface import MovingSurface


@dataclass(frozen=True, eq=False)
class Pair:
    """A predicted frame and its truth; P pixels are scored."""

    #: (H, W, 3) float in [0, 1], sRGB over black.
    prediction: np.ndarray
    #: (H, W, 3) float in [0, 1], sRGB.
    target: np.ndarray
    #: (H, W) bool.
    region: np.ndarray
    #: (H, W, 3) unit normals of the posed hand in world axes; zeros where the hand is not drawn.
    normals: np.ndarray
    #: How the estimated hands' surface moves the pixels; None where no hand is known.
    surface: MovingSurface | None = None

    @property
    def error(self) -> float:
        """Mean squared error over the scored pixels."""
        return error_of(self.prediction, self)


def error_of(image: np.ndarray, pair: Pair) -> float:
    """Mean squared error of an image (H, W, 3) in place of the prediction."""
    return float(squared_error(image, pair.target)[pair.region].mean())
