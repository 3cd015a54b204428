"""Which pixels are inliers: a running quantile of errors, and rules on neighbourhoods."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import avg_pool2d, pad

#: Bins of the histogram over [0, 1].
BINS = 10_000
#: Edge of the neighbourhood whose majority counts, px.
BOX = 3
#: Edge of a patch, and of its inner part that the patch's majority decides, px.
PATCH, INNER = 16, 8


class ErrorHistogram:
    """A histogram of errors that forgets; quantiles are read from it.

    Args:
        decay: share that stays when errors are added.
        device: where the errors are.

    Source: Sabour et al., "SpotLessSplats", and its code; RobustNeRF takes the
    quantile of the last batch, which is a decay of 0.
    """

    def __init__(self, decay: float, device: torch.device) -> None:
        self.decay = decay
        self.counts = torch.zeros(BINS, dtype=torch.float64, device=device)

    def add(self, errors: torch.Tensor) -> None:
        """Add errors of any shape; those above 1 fall into the last bin."""
        bins = (errors.flatten() * BINS).long().clamp(0, BINS - 1)
        self.counts = self.decay * self.counts + torch.bincount(bins, minlength=BINS)

    def quantile(self, share: float) -> float:
        """The upper edge of the bin that a share of the errors does not exceed.

        Args:
            share: in [0, 1].

        Returns:
            in (0, 1]; 1 while nothing has been added, so that every pixel is an inlier.
        """
        total = self.counts.cumsum(0)
        if float(total[-1]) == 0.0:
            return 1.0
        index = int(torch.searchsorted(total, share * total[-1]))
        return min(index + 1, BINS) / BINS


def pixel_errors(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean absolute error over channels: (B, H, W) of two (B, H, W, C), without gradient."""
    return (image.detach() - target).abs().mean(dim=-1)


def find_inliers(
    errors: torch.Tensor, hand: torch.Tensor, threshold: float, *, box: bool, patch: bool
) -> torch.Tensor:
    """Judge the pixels of the hand by their errors and by those of their neighbours.

    A pixel is an inlier if its error is below the threshold, if most of its 3 x 3 neighbourhood
    is, or if it lies in the inner 8 x 8 px of a patch of 16 x 16 px of which most is. Only pixels
    of the hand are counted: the others are black in both images, so they say nothing.

    Args:
        errors: (B, H, W) not negative.
        hand: (B, H, W) bool, the pixels that are judged.
        threshold: of the errors.
        box: whether the 3 x 3 neighbourhood counts.
        patch: whether the patches count.

    Returns:
        (B, H, W) bool; True outside the hand, where nothing is judged.

    Source: Sabour et al., "RobustNeRF", and its code, in which the patch's
    majority is over pixels below the threshold.
    """
    below = (errors < threshold) & hand
    inliers = below | ~hand
    if box:
        inliers = inliers | (_share(below, hand, BOX, 1, BOX // 2) > 0.5)
    if patch:
        height, width = errors.shape[1:]
        room = (0, -width % INNER, 0, -height % INNER)
        blocks = _share(pad(below, room), pad(hand, room), PATCH, INNER, (PATCH - INNER) // 2) > 0.5
        wide = blocks.repeat_interleave(INNER, dim=1).repeat_interleave(INNER, dim=2)
        inliers = inliers | wide[:, :height, :width]
    return inliers


def _share(
    below: torch.Tensor, hand: torch.Tensor, edge: int, stride: int, margin: int
) -> torch.Tensor:
    """Share of inliers among the pixels of the hand in each window; 0 where there is no hand."""
    both = torch.stack((below, hand), dim=1).float()
    counted, all_of_them = avg_pool2d(both, edge, stride, margin).unbind(1)
    return counted / all_of_them.clamp(min=1e-6)


def chance_of_all(fraction: float, schedule_steps: float) -> float:
    """The share alpha of pixels that are kept whatever their error; it falls from 1 to 0.

    Args:
        fraction: share of the fit that is done, in [0, 1).
        schedule_steps: steps of the published schedule that the whole fit stands for; 0 gives 0.

    Returns:
        exp(-0.003 floor((1 + step) / 1.5)) at the published schedule's step.

    Source: the code of SpotLessSplats.
    """
    if schedule_steps == 0.0:
        return 0.0
    return math.exp(-3e-3 * math.floor((1.0 + fraction * schedule_steps) / 1.5))
