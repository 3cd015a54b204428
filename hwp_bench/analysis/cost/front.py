"""Mean curves of methods with their intervals, and the front that no method gets beyond."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from hwp_bench.analysis.cost.curves import Curve, mean_at

#: Moments at which curves are read for the front.
MOMENTS = 400


@dataclass(frozen=True, eq=False)
class MeanCurve:
    """The mean curve of one method over captures, with a 95 % interval."""

    #: Its label.
    label: str
    #: (T,) seconds, ascending.
    seconds: np.ndarray
    #: (T,) mean score over captures, each a mean over seeds.
    scores: np.ndarray
    #: (T,) lower end of the interval over captures; None with one capture.
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
    """Return the mean curve of a method.

    Args:
        label: its label.
        curves: the curves of every seed, by capture.

    Returns:
        The mean from the first moment at which every fit has had a checkpoint to the end of the
        longest fit, and Student's interval over captures; None without curves.
    """
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
    rows = np.stack([mean_at(fits, moments) for fits in curves.values()])
    mean = rows.mean(axis=0)
    if len(rows) < 2:
        return MeanCurve(label, moments, mean, None, None)
    from scipy.stats import t

    reach = t.ppf(0.975, len(rows) - 1) * rows.std(axis=0, ddof=1) / len(rows) ** 0.5
    return MeanCurve(label, moments, mean, mean - reach, mean + reach)


def pareto_front(curves: Sequence[MeanCurve], higher_is_better: bool) -> list[FrontPart]:
    """Return who has the best score after which time: the points that nothing dominates.

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
    leaders = values.argmax(axis=0)
    best = values.max(axis=0)
    gains = best > np.concatenate([[-np.inf], np.maximum.accumulate(best)[:-1]])
    points = [
        (int(leaders[place]), float(moments[place]), float(sign * best[place]))
        for place in np.flatnonzero(gains)
    ]
    parts = []
    for leader, group in groupby(points, key=lambda point: point[0]):
        stretch = list(group)
        (_, begin, first), (_, end, last) = stretch[0], stretch[-1]
        parts.append(FrontPart(curves[leader].label, begin, end, first, last))
    return parts


def _on(curve: MeanCurve, moments: np.ndarray) -> np.ndarray:
    values = np.interp(np.log(moments), np.log(curve.seconds), curve.scores)
    return np.where(moments < curve.seconds[0], np.nan, values)
