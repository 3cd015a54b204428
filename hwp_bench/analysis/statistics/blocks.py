"""Resampling inside one capture: seeds, and blocks of consecutive frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Blocks:
    """The overlapping blocks of frames of one capture.

    Neighbouring frames of a video say nearly the same, so single frames must not be drawn as if
    they were independent; blocks of about sqrt(F) frames are. Blocks wrap around at the end, so
    that every frame is in as many as any other (circular block bootstrap, Politis and Romano
    1992).
    """

    #: (S, F) mean over the block that starts at each frame, for each seed.
    means: np.ndarray
    #: Blocks that make up one resampled capture.
    count: int

    @property
    def value(self) -> float:
        """Mean over all seeds and frames."""
        return float(self.means.mean())

    @property
    def variance(self) -> float:
        """Estimated variance of `value`: that of blocks, and of seeds where there are several."""
        frames = float(self.means.mean(axis=0).var()) / max(self.count - 1, 1)
        seeds = len(self.means)
        return frames + (float(self.means.mean(axis=1).var(ddof=1)) / seeds if seeds > 1 else 0.0)

    @property
    def degrees_of_freedom(self) -> int:
        """Units behind `variance`, less one: the fewest of blocks and (if several) seeds."""
        units = [self.count, len(self.means)] if len(self.means) > 1 else [self.count]
        return min(units) - 1

    def errors(self, draws: int, random: np.random.Generator) -> np.ndarray:
        """Draw resampled means minus `value`, spread as `variance` says.

        Args:
            draws: how many.
            random: where from.

        Returns:
            (draws,) float. Blocks are drawn with replacement; so are seeds, apart from the
            blocks, because every seed is scored on the same frames. Drawing from few loses part
            of the variance, which is put back.
        """
        starts = random.integers(0, self.means.shape[1], (draws, self.count))
        errors = _restored(self.count) * (self.means.mean(axis=0)[starts].mean(axis=1) - self.value)
        if len(self.means) > 1:
            seeds = random.integers(0, len(self.means), (draws, len(self.means)))
            drawn = self.means.mean(axis=1)[seeds].mean(axis=1)
            errors += _restored(len(self.means)) * (drawn - self.value)
        return errors


def _restored(count: int) -> float:
    """Factor that makes up for the spread that `count` draws from `count` units lose."""
    return (count / max(count - 1, 1)) ** 0.5


def make_blocks(values: np.ndarray) -> Blocks:
    """Return the blocks of one capture.

    Args:
        values: (S, F) float, one row a seed, frames in order.
    """
    frames = values.shape[1]
    length = max(1, round(frames**0.5))
    around = np.concatenate([values, values[:, : length - 1]], axis=1)
    totals = np.concatenate([np.zeros((len(values), 1)), around.cumsum(axis=1)], axis=1)
    return Blocks((totals[:, length:] - totals[:, :frames]) / length, -(-frames // length))
