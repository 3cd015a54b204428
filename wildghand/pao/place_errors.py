"""Ordinary errors by place: an error in every frame of a clip is not a perturbation."""

from __future__ import annotations

import torch
from torch import Tensor

from wildghand.gaussians.training import upload
from wildghand.pao.regions import ClipRegions
from wildghand.pao.running_median import LEAST

#: Share of the newest error of a place in its ordinary one, in a frame that is surely clean.
RATE = 0.1
#: An error counts at most this often the ordinary one: something in front changes it slowly.
MOST = 3.0


class PlaceErrors:
    """The ordinary error of each place of the hand at this point of a fit.

    A hand that is not the template, a nail, a ring or poses that are always a little wrong leave
    errors at the same places in every frame. Regions are compared with these, not with the mean
    hand, and never with less than the running median of all regions.

    Args:
        places: the place of each pixel of the R frames; frames share their numbers.
        trust: (R,) in [0, 1], how much a frame may teach what is ordinary: the probability that it
            is clean.
        count: C, places of the clip; they are numbered from 0.

    Attributes:
        ordinary: (C,) mean over channels of |rendering - input|; 0 where nothing is known.
    """

    def __init__(self, places: ClipRegions, trust: Tensor, count: int) -> None:
        self._places, self._trust = places, trust
        self.ordinary = torch.zeros(count, device=trust.device)

    def expected(self, rows: Tensor, median: float | Tensor) -> Tensor:
        """The ordinary error at every pixel, at least the running median.

        Args:
            rows: (B,) int64 on the CPU, which of the frames.
            median: of the regions' errors.

        Returns:
            (B, H, W), positive.
        """
        places = self._places(rows)
        floor = torch.clamp(self.ordinary, min=LEAST)
        floor = torch.maximum(floor, torch.as_tensor(median, device=floor.device).to(floor))
        # The regions of a batch may end before the last place of the clip.
        return places.spread(floor[: places.count].expand(len(rows), -1).contiguous())

    @torch.no_grad()
    def watch(self, rows: Tensor, error: Tensor, hand: Tensor, median: float | Tensor) -> None:
        """Learn from B frames.

        Args:
            rows: (B,) int64 on the CPU.
            error: (B, H, W) mean over channels of |rendering - input|; finite where `hand` is.
            hand: (B, H, W) bool.
            median: of the regions' errors; the first error of a place counts at most `MOST` times.
        """
        places, ones = self._places(rows), hand.to(error)
        pixels = places.sums(ones)
        errors = places.sums(torch.where(hand, error, torch.zeros_like(error)))
        errors = errors / pixels.clamp(min=1.0)
        unit = torch.as_tensor(median, device=error.device).to(error)
        trusts = self._trust[upload(rows, self._trust.device)]
        ordinary = self.ordinary[: places.count]
        for mine, seen, trust in zip(errors, pixels > 0.0, trusts, strict=True):
            known = torch.where(ordinary > 0.0, ordinary, unit)
            bounded = torch.minimum(mine, MOST * torch.maximum(known, unit))
            moved = known + RATE * trust * (bounded - known)
            ordinary = torch.where(seen & mine.isfinite(), moved, ordinary)
        self.ordinary = torch.cat([ordinary, self.ordinary[places.count :]])
