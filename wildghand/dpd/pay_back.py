"""Pay back: what the biases of a frame explain, the frame may teach the canonical hand."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from wildghand.gaussians.training import upload

#: Share of the newest residual of a frame in its running one.
_RATE = 0.5
#: Probability from which a frame says what an ordinary residual is.
_CLEAN_FROM = 0.5


class PayBack:
    """How well each frame is explained, biases included, next to the clean frames.

    The share of frame l is exp(-(r_l / (tolerance r_clean))^2): r_l is the running mean error of
    its hand as drawn with its biases, r_clean the median of the clean frames'.

    Args:
        clean: (R,) probability that a frame is clean, where the fit runs.
        tolerance: above 0.

    Attributes:
        residuals: (R,) r; 0 for a frame that has not been drawn.
    """

    def __init__(self, clean: Tensor, tolerance: float) -> None:
        self.residuals = torch.zeros_like(clean)
        self._clean = clean > _CLEAN_FROM
        self._tolerance = tolerance

    @torch.no_grad()
    def watch(self, rows: Tensor, error: Tensor, weights: Tensor) -> None:
        """Take in how well B frames are drawn.

        Args:
            rows: (B,) int64, which of the R frames; on the CPU.
            error: (B, H, W) mean over channels of |rendering - input|.
            weights: (B, H, W) how much the pixels count; off the hand 0.
        """
        known = torch.nan_to_num(error) * weights
        newest = known.sum(dim=(1, 2)) / weights.sum(dim=(1, 2)).clamp(min=1.0)
        rows = upload(rows, self.residuals.device)
        before = self.residuals[rows]
        mixed = torch.where(before > 0.0, before + _RATE * (newest - before), newest)
        self.residuals.index_copy_(0, rows, mixed)

    @torch.no_grad()
    def shares(self, rows: Tensor) -> Tensor:
        """(B,) in [0, 1] how much of B frames is explained; 0 while that is not known.

        Args:
            rows: (B,) int64, which of the R frames; on the CPU.
        """
        drawn = self._clean & (self.residuals > 0.0)
        ordinary = torch.where(drawn, self.residuals, math.nan).nanmedian()
        residual = self.residuals[upload(rows, self.residuals.device)]
        found = torch.exp(-((residual / (self._tolerance * ordinary)) ** 2))
        return torch.where((residual > 0.0) & ordinary.isfinite(), found, 0.0)
