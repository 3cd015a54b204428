"""Scores of captures whose training frames a perturbation spoils at one severity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

from hwp_bench.capture.splits import split_for
from hwp_bench.metrics.score import CaptureScores
from hwp_bench.sim.produce.suites import suite
from hwp_bench.sim.scene.episodes import moments, severity

#: By capture and perturbation: mean severity of the frames that show it, rounded.
Severities = Mapping[str, Mapping[str, int]]


@cache
def suite_severities(name: str) -> Severities:
    """Return how severe each perturbation of each capture of a suite is.

    It is read from the scenes, so that no capture has to be on this machine: the mean over the
    frames to learn from that show the perturbation, rounded, as `hwp-bench table --by severity`
    takes it from captures.

    Args:
        name: a suite.

    Raises:
        UsageError: there is no such suite.
    """
    found: dict[str, dict[str, int]] = {}
    for item in suite(name):
        test = set(split_for(item.scene.id, item.frame_count).test.tolist())
        learnt = [
            moment
            for frame, moment in enumerate(moments(item.frame_count).tolist())
            if frame not in test
        ]
        own = found.setdefault(item.scene.id, {})
        for call in item.scene.effects:
            shown = [value for moment in learnt if (value := severity(call, moment))]
            own[call.kind] = round(sum(shown) / len(shown)) if shown else 0
    return found


def at_severity(
    captures: Sequence[CaptureScores], severities: Severities, level: int
) -> list[CaptureScores]:
    """Return the captures that have a perturbation of one severity, with these perturbations only.

    Args:
        captures: scores of captures of the suite.
        severities: what `suite_severities` returned for it.
        level: 1 to 5.

    Returns:
        Fewer captures; empty where none has a perturbation of that severity.
    """
    found = []
    for capture in captures:
        own = severities.get(capture.id, {})
        kept = tuple(name for name in capture.perturbations if own.get(name) == level)
        if kept:
            found.append(replace(capture, perturbations=kept))
    return found
