"""Curves of validation score over seconds: of one fit, of a method, and their Pareto front."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from hwp_bench.results import CaptureResult

#: Checkpoints earlier than this are taken to be at this moment, s: log time needs one above 0.
EARLIEST = 1e-3
#: Fewest captures that have an interval: Student's t of two is 12.7, which says nothing.
LEAST_CAPTURES = 3
#: Moments at which curves are read for the front.
MOMENTS = 400


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
        """Return the scores after some times, s, in their shape.

        NaN before the first checkpoint; after the end that of the finished fit, which one has.
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
    # Of several checkpoints at one moment the last counts: a curve has one score at a time.
    last = np.append(np.diff(seconds) > 0, True)
    return Curve(seconds[last], scores[last])


@dataclass(frozen=True, eq=False)
class MeanCurve:
    """The mean curve of one method over captures, with a 95 % interval."""

    #: Its label.
    label: str
    #: (T,) seconds, ascending.
    seconds: np.ndarray
    #: (T,) mean score over captures, each a mean over seeds.
    scores: np.ndarray
    #: (T,) lower end of the interval over captures; None with fewer than `LEAST_CAPTURES`.
    low: np.ndarray | None
    #: (T,) upper end.
    high: np.ndarray | None


@dataclass(frozen=True)
class FrontPart:
    """A stretch of time in which one method has the best score of all."""

    #: The method's label.
    label: str
    #: When it takes the lead, s.
    start: float
    #: When its last gain in the lead comes, s.
    stop: float
    #: Its score when it takes the lead.
    first_score: float
    #: Its score at the last gain.
    last_score: float


def mean_curve(label: str, curves: Mapping[str, Sequence[Curve]]) -> MeanCurve | None:
    """Return the mean curve of a method."""
    every = [curve for fits in curves.values() for curve in fits]
    if not every:
        return None
    start = max(float(curve.seconds[0]) for curve in every)
    stop = max(start, max(float(curve.seconds[-1]) for curve in every))
    # The checkpoints themselves are corners of the mean, so none may be stepped over.
    corners = np.concatenate([curve.seconds for curve in every])
    between = corners[(corners > start) & (corners < stop)]
    moments = np.unique(np.concatenate([np.geomspace(start, stop, 60), between, [start, stop]]))
    moments = moments[(moments >= start) & (moments <= stop)]
    rows = np.stack([np.mean([c.at(moments) for c in fits], axis=0) for fits in curves.values()])
    mean = rows.mean(axis=0)
    if len(rows) < LEAST_CAPTURES:
        return MeanCurve(label, moments, mean, None, None)
    from scipy.stats import t

    reach = t.ppf(0.975, len(rows) - 1) * rows.std(axis=0, ddof=1) / len(rows) ** 0.5
    return MeanCurve(label, moments, mean, mean - reach, mean + reach)


def pareto_front(curves: Sequence[MeanCurve], higher_is_better: bool) -> list[FrontPart]:
    """Return the method with the best score after each time: the points that no other dominates.

    A point is on the front when no method has as good a score in less time. A method that has
    ended keeps its score, and so adds nothing to the front any more.
    """
    if not curves:
        return []
    start = min(curve.seconds[0] for curve in curves)
    stop = max(curve.seconds[-1] for curve in curves)
    inner = np.concatenate([curve.seconds for curve in curves])
    moments = np.unique(np.concatenate([np.geomspace(start, stop, MOMENTS), inner]))
    moments = moments[(moments >= start) & (moments <= stop)]
    sign = 1 if higher_is_better else -1
    # A method that has no score yet is as bad as can be.
    values = np.stack([np.nan_to_num(sign * _on(c, moments), nan=-np.inf) for c in curves])
    best_of = values.argmax(axis=0)
    best = values.max(axis=0)
    gains = best > np.concatenate([[-np.inf], np.maximum.accumulate(best)[:-1]])
    points = [
        (int(best_of[place]), float(moments[place]), float(sign * best[place]))
        for place in np.flatnonzero(gains)
    ]
    parts = []
    for index, group in groupby(points, key=lambda point: point[0]):
        stretch = list(group)
        (_, begin, first), (_, end, last) = stretch[0], stretch[-1]
        parts.append(FrontPart(curves[index].label, begin, end, first, last))
    return parts


def _on(curve: MeanCurve, moments: np.ndarray) -> np.ndarray:
    values = np.interp(np.log(moments), np.log(curve.seconds), curve.scores)
    return np.where(moments < curve.seconds[0], np.nan, values)
