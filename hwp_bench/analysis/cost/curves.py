"""The curve of one fit: validation score over seconds, read in log time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.results import CaptureResult

#: Checkpoints earlier than this are taken to be at this moment, s: log time needs one above 0.
EARLIEST = 1e-3


@dataclass(frozen=True, eq=False)
class Curve:
    """Score over time of one fit. Between checkpoints it is linear in the log of the seconds."""

    #: (N,) seconds on the method's clock, ascending, above 0.
    seconds: np.ndarray
    #: (N,) mean score over the validation frames.
    scores: np.ndarray

    @property
    def final(self) -> float:
        """Score of the finished fit."""
        return float(self.scores[-1])

    def at(self, seconds: float | np.ndarray) -> np.ndarray:
        """Return the score after some time.

        Args:
            seconds: when, s; any shape.

        Returns:
            The scores, in the same shape: NaN before the first checkpoint; after the end that of
            the finished fit, which one then has.
        """
        moments = np.asarray(seconds, dtype=np.float64)
        values = np.interp(np.log(moments), np.log(self.seconds), self.scores)
        return np.where(moments < self.seconds[0], np.nan, values)

    def time_to(self, target: float, higher_is_better: bool) -> float:
        """Return the seconds until the curve first reaches a score, infinity if it never does.

        A curve that is there at its first checkpoint has that checkpoint's time: it may have been
        there earlier.
        """
        gains = (self.scores - target) * (1 if higher_is_better else -1)
        reached = np.flatnonzero(gains >= 0)
        if not len(reached):
            return math.inf
        index = int(reached[0])
        if index == 0:
            return float(self.seconds[0])
        share = gains[index - 1] / (gains[index - 1] - gains[index])
        low, high = np.log(self.seconds[index - 1 : index + 1])
        between = np.exp(low + share * (high - low))
        # Logarithm and exponential do not undo each other to the last digit.
        return float(np.clip(between, *self.seconds[index - 1 : index + 1]))

    def log_area(self, start: float, stop: float) -> float:
        """Return the mean score over the log of the time from `start` to `stop`, seconds.

        NaN where the curve begins after `start`; `stop` must lie above `start`.
        """
        inner = self.seconds[(self.seconds > start) & (self.seconds < stop)]
        moments = np.array([start, *inner, stop])
        logs = np.log(moments)
        values = self.at(moments)
        pieces = np.diff(logs) * (values[1:] + values[:-1]) / 2
        return float(pieces.sum() / (logs[-1] - logs[0]))


def curve_of(result: CaptureResult, metric: str) -> Curve | None:
    """Return the curve of one capture; None where there is none in this metric."""
    points = [point for point in result.curve if metric in point.scores]
    if not points:
        return None
    seconds = np.maximum.accumulate([max(point.seconds, EARLIEST) for point in points])
    scores = np.array([point.scores[metric] for point in points])
    # Of several checkpoints at one moment the last counts: log time could not tell them apart.
    last = np.append(np.diff(seconds) > 0, True)
    return Curve(seconds[last], scores[last])


def mean_at(curves: Sequence[Curve], seconds: np.ndarray) -> np.ndarray:
    """Return the mean score of several fits at some moments, (T,) float.

    NaN until every fit has had its first checkpoint.
    """
    return np.mean([curve.at(seconds) for curve in curves], axis=0)
