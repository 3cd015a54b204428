"""From frame scores to the numbers of a table: frame -> capture -> perturbation -> mean.

Sums are exact before they are rounded once (`math.fsum`), so the order of captures and frames
never changes a digit.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from hwp_bench.base.errors import BadResult

Scores = dict[str, float]


@dataclass(frozen=True)
class CaptureScores:
    """The frame scores of one capture."""

    #: Name of the capture, unique in one aggregation.
    id: str
    #: "right", "left" or "both".
    hands: str
    #: Perturbations of the capture; may be empty.
    perturbations: tuple[str, ...]
    #: Frame -> metric -> score: every scored frame, the penalties of failed ones included.
    frames: Mapping[Hashable, Mapping[str, float]]

    @property
    def interacting(self) -> bool:
        """True where two hands are shown."""
        return self.hands == "both"


@dataclass(frozen=True)
class Summary:
    """Means over one set of captures, metric -> score each."""

    #: Mean over the frames of each capture, by capture.
    captures: dict[str, Scores]
    #: Mean over the captures with it, by perturbation.
    perturbations: dict[str, Scores]
    #: Mean over the perturbations: each perturbation counts the same. Empty where no capture
    #: has one.
    macro: Scores
    #: Mean over the captures: each capture counts the same.
    capture_mean: Scores
    #: Mean over all frames: each frame counts the same.
    micro: Scores


@dataclass(frozen=True)
class Aggregate:
    """The summaries that tables are made of."""

    #: Over all captures.
    overall: Summary
    #: Over the captures of one hand; None if there are none.
    single: Summary | None = None
    #: Over the captures of two hands; None if there are none.
    interacting: Summary | None = None


def aggregate(captures: Iterable[CaptureScores]) -> Aggregate:
    """Average frame scores; nothing is dropped, and NaN and infinity are refused.

    Args:
        captures: the scored captures; each lists every frame that was scored.

    Returns:
        the summaries of all captures, of the single hands, and of the interacting hands.

    Raises:
        BadResult: no capture; a capture twice or without frames; a score that is NaN or
            infinite; frames that do not all have the same metrics.
    """
    listed = list(captures)
    _check(listed)
    single = [capture for capture in listed if not capture.interacting]
    interacting = [capture for capture in listed if capture.interacting]
    return Aggregate(
        overall=_summarize(listed),
        single=_summarize(single) if single else None,
        interacting=_summarize(interacting) if interacting else None,
    )


def mean_scores(rows: Iterable[Mapping[str, float]]) -> Scores:
    """Mean of each metric over `rows`, which all have the same metrics; {} for no rows."""
    listed = list(rows)
    if not listed:
        return {}
    return {
        name: math.fsum(row[name] for row in listed) / len(listed) for name in sorted(listed[0])
    }


def _summarize(captures: Sequence[CaptureScores]) -> Summary:
    by_id = sorted(captures, key=lambda capture: capture.id)
    means = {capture.id: mean_scores(capture.frames.values()) for capture in by_id}
    names = sorted({name for capture in by_id for name in capture.perturbations})
    perturbations = {
        name: mean_scores(means[c.id] for c in by_id if name in c.perturbations) for name in names
    }
    frames = [row for capture in by_id for row in capture.frames.values()]
    return Summary(
        captures=means,
        perturbations=perturbations,
        macro=mean_scores(perturbations.values()),
        capture_mean=mean_scores(means.values()),
        micro=mean_scores(frames),
    )


def _check(captures: Sequence[CaptureScores]) -> None:
    if not captures:
        raise BadResult("there are no captures to average", field="captures")
    seen: set[str] = set()
    metrics: frozenset[str] | None = None
    for capture in captures:
        if capture.id in seen:
            raise BadResult("is listed twice", where=capture.id, field="id")
        seen.add(capture.id)
        if not capture.frames:
            raise BadResult(
                "has no scored frame",
                where=capture.id,
                field="frames",
                remedy="Every capture of a result must have at least one frame with a hand.",
            )
        for frame, row in capture.frames.items():
            names = frozenset(row)
            metrics = names if metrics is None else metrics
            if names != metrics or not names:
                odd = ", ".join(sorted(names ^ metrics)) or "none at all"
                raise BadResult(
                    f"its metrics differ from the other frames' ({odd})",
                    where=capture.id,
                    field=f"frames[{frame}]",
                )
            for name, score in row.items():
                if not math.isfinite(score):
                    raise BadResult(
                        f"the score is {score}", where=capture.id, field=f"frames[{frame}].{name}"
                    )
