"""From result files to paired differences: which runs belong together, which may be compared."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.metrics.score import CaptureScores, Scores, aggregate
from hwp_bench.results import Results
from hwp_bench.results.schema import (
    CaptureResult,
    budget_text,
    differing_makers,
    differing_settings,
    shown_files,
    without_places,
)
from hwp_bench.taxonomy import PERTURBATIONS

#: Scope of the headline: every perturbation counts the same, as the macro mean of the tables.
MACRO = "macro"


@dataclass(frozen=True)
class MethodRuns:
    """One method in one state, with one evaluation a seed."""

    #: Name in tables, unique in one comparison.
    label: str
    #: The evaluations by seed.
    seeds: Mapping[int, Results]

    @property
    def first(self) -> Results:
        """The evaluation of the lowest seed."""
        return self.seeds[min(self.seeds)]

    def values(self, capture: str, metric: str, seeds: Sequence[int]) -> np.ndarray:
        """Return the scores of one capture: (S, F) float, frames in the split's order."""
        chosen = [next(c for c in self.seeds[s].captures if c.id == capture) for s in seeds]
        rows = [[frame.scores for frame in one.frames] for one in chosen]
        if any(metric not in scores for row in rows for scores in row):
            raise UsageError(f"has frames without {metric}", where=self.label, field=capture)
        return np.array([[scores[metric] for scores in row] for row in rows])


def same_but_seed(result: Results) -> str:
    """Return a digest (hex) that two evaluations share when they differ in nothing but the seed.

    Method, preset, settings, files that it was shown, budget, kind of training frames and suite
    count; machine, captures and the places of files do not.
    """
    method, settings = result.method, without_places(result.method.settings)
    state = [method.name, method.title, method.digest, method.preset, settings]
    return sha256_json([state, shown_files(result), result.budget, result.frames, result.suite])


def group_runs(results: Sequence[Results]) -> list[MethodRuns]:
    """Put evaluations that differ in nothing but the seed together, in the order given."""
    groups: dict[str, dict[int, Results]] = {}
    for result in results:
        seeds = groups.setdefault(same_but_seed(result), {})
        if result.seed in seeds:
            _refuse_unlike_pair(f"two results of {result.method.title}", seeds[result.seed], result)
            raise UsageError(
                f"two results are of {result.method.title} with seed {result.seed} and the same "
                "settings",
                remedy="Give each result once.",
            )
        seeds[result.seed] = result
    runs = list(groups.values())
    firsts = [next(iter(seeds.values())) for seeds in runs]
    return [MethodRuns(label, own) for label, own in zip(_labels(firsts), runs, strict=True)]


def _labels(results: Sequence[Results]) -> list[str]:
    """Return titles, followed by what differs, or led by a number where nothing readable does."""
    differences = differing_settings(results)
    states = [_state(result) for result in results]
    digests = [result.method.digest[:8] for result in results]
    empty = [""] * len(results)
    labels: list[str] = []
    for told in (
        (empty,),
        (differences,),
        (states,),
        (states, differences),
        (states, differences, digests),
    ):
        parts = [", ".join(filter(None, own)) for own in zip(*told, strict=True)]
        titles = [result.method.title for result in results]
        labels = [f"{t} ({own})" if own else t for t, own in zip(titles, parts, strict=True)]
        if len(set(labels)) == len(labels):
            return labels
    return [f"{index + 1}: {label}" for index, label in enumerate(labels)]


def _state(result: Results) -> str:
    parts = [
        result.method.preset,
        f"{result.frames} frames" if result.frames != "perturbed" else "",
        budget_text(result.budget) if any(result.budget.values()) else "",
        *(f"files {digest[:8]}" for digest in shown_files(result)),
    ]
    return ", ".join(filter(None, parts))


def refuse_unlike(runs: Sequence[MethodRuns]) -> None:
    """Refuse results whose difference would not be that of the methods."""
    everything = [(run.label, result) for run in runs for result in run.seeds.values()]
    label, reference = everything[0]
    for other_label, other in everything[1:]:
        _refuse_unlike_pair(f"{label} and {other_label}", reference, other)


def _refuse_unlike_pair(between: str, reference: Results, other: Results) -> None:
    refuse_other_scoring(between, reference, other)
    _same_captures(between, reference, other)


def refuse_other_scoring(between: str, reference: Results, other: Results) -> None:
    """Refuse results of other protocols or kinds of training frames; `between` names both."""
    if other.protocols != reference.protocols:
        names = sorted(
            name
            for name in other.protocols.keys() | reference.protocols.keys()
            if other.protocols.get(name) != reference.protocols.get(name)
        )
        raise UsageError(
            f"{between} were scored by different protocols ({', '.join(names)})",
            field="protocols",
            remedy="Score both with the same version of the toolkit.",
        )
    if other.frames != reference.frames:
        raise UsageError(
            f"{between} were given different training frames "
            f"({reference.frames} and {other.frames})",
            field="frames",
            remedy="Compare runs with the same --train-on.",
        )


def _same_captures(between: str, reference: Results, other: Results) -> None:
    ours = {capture.id: capture for capture in reference.captures}
    theirs = {capture.id: capture for capture in other.captures}
    if ours.keys() != theirs.keys() or not ours:
        odd = ", ".join(sorted(ours.keys() ^ theirs.keys())) or "none at all"
        raise UsageError(
            f"{between} were not evaluated on the same captures ({odd})",
            field="captures",
            remedy="Evaluate both on the same suite.",
        )
    for identifier, capture in ours.items():
        refuse_other_frames(between, capture, theirs[identifier])


def refuse_other_frames(between: str, capture: CaptureResult, twin: CaptureResult) -> None:
    """Refuse results of one capture whose frames cannot be paired; `between` names both."""
    if capture.exact_masks != twin.exact_masks:
        problem, field = "different masks (exact and estimated)", "exact_masks"
    elif capture.digest != twin.digest:
        problem, field = "different data", "digest"
    elif capture.split_digest != twin.split_digest:
        problem, field = "different splits", "split_digest"
    elif [f.frame for f in capture.frames] != [f.frame for f in twin.frames]:
        problem, field = "different test frames", "frames"
    else:
        return
    raise UsageError(
        f"{between} were evaluated on {problem} under the name {capture.id}"
        + differing_makers(capture, twin),
        where=capture.id,
        field=field,
        remedy="Evaluate both on the same captures with the same splits.",
    )


def common_seeds(first: MethodRuns, second: MethodRuns) -> list[int]:
    """Return the seeds that both have."""
    seeds = sorted(first.seeds.keys() & second.seeds.keys())
    if not seeds:
        raise UsageError(
            f"{first.label} and {second.label} have no seed in common",
            field="seed",
            remedy="Evaluate both with the same --seed.",
        )
    return seeds


def scopes(results: Results) -> dict[str, dict[str, float]]:
    """Return the sets of captures that are averaged, with the weight of each capture."""
    captures = results.captures
    ones = {capture.id: 1.0 for capture in captures}
    carriers = {
        name: {c.id: 1.0 for c in captures if name in c.perturbations} for name in PERTURBATIONS
    }
    macro: dict[str, float] = {}
    for own in carriers.values():
        for identifier in own:
            macro[identifier] = macro.get(identifier, 0.0) + 1 / len(own)
    found = {
        MACRO: macro or ones,
        "single": {c.id: 1.0 for c in captures if c.hands != "both"},
        "interacting": {c.id: 1.0 for c in captures if c.hands == "both"},
        **carriers,
    }
    return {name: weights for name, weights in found.items() if weights}


def scope_scores(captures: Iterable[CaptureScores]) -> dict[str, Scores]:
    """Return the mean scores of each scope that has any: those of `scopes`."""
    mean = aggregate(captures)
    found = {
        MACRO: mean.overall.macro or mean.overall.capture_mean,
        "single": mean.single.capture_mean if mean.single else {},
        "interacting": mean.interacting.capture_mean if mean.interacting else {},
        **mean.overall.perturbations,
    }
    return {scope: scores for scope, scores in found.items() if scores}


def common_metrics(runs: Sequence[MethodRuns], names: Sequence[str]) -> list[str]:
    """Return those of `names` that every evaluation has."""
    measured = [set(result.metrics) for run in runs for result in run.seeds.values()]
    return [name for name in names if all(name in known for known in measured)]
