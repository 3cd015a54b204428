"""From result files to paired differences: which runs belong together, which may be compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.results import CaptureResult, Results
from hwp_bench.results.schema import differing_makers, differing_settings
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
        """Return the scores of one capture: (S, F) float, frames in the split's order.

        Raises:
            UsageError: a frame lacks the metric, which others of the result have.
        """
        rows = [[f.scores for f in _capture(self.seeds[seed], capture).frames] for seed in seeds]
        if any(metric not in scores for row in rows for scores in row):
            raise UsageError(f"has frames without {metric}", where=self.label, field=capture)
        return np.array([[scores[metric] for scores in row] for row in rows])


def _capture(results: Results, identifier: str) -> CaptureResult:
    return next(capture for capture in results.captures if capture.id == identifier)


def same_but_seed(result: Results) -> str:
    """Return a digest (hex) that two evaluations share when they differ in nothing but the seed.

    Method, preset, settings, budget, kind of training frames and suite count; machine and captures
    do not.
    """
    method = result.method
    state = [method.name, method.title, method.digest, method.preset, method.settings]
    return sha256_json([state, result.budget, result.frames, result.suite])


def group_runs(results: Sequence[Results]) -> list[MethodRuns]:
    """Put evaluations that differ in nothing but the seed together, in the order given.

    Raises:
        UsageError: two evaluations are of the same method, settings, budget and seed.
    """
    groups: dict[str, dict[int, Results]] = {}
    for result in results:
        seeds = groups.setdefault(same_but_seed(result), {})
        if result.seed in seeds:
            raise UsageError(
                f"two results are of {result.method.title} with seed {result.seed} and the same "
                "settings",
                remedy="Give each result once.",
            )
        seeds[result.seed] = result
    runs = list(groups.values())
    return [
        MethodRuns(label, seeds)
        for label, seeds in zip(_labels([next(iter(r.values())) for r in runs]), runs, strict=True)
    ]


def _labels(results: Sequence[Results]) -> list[str]:
    """Return titles, followed by what differs, or led by a number where nothing readable does."""
    titles = [result.method.title for result in results]
    states = [_state(result) for result in results]
    differences = differing_settings(results)
    digests = [result.method.digest[:8] for result in results]
    for tellings in (
        [],
        [differences],
        [states],
        [states, differences],
        [states, differences, digests],
    ):
        labels = [_label(title, *parts) for title, *parts in zip(titles, *tellings, strict=True)]
        if len(set(labels)) == len(labels):
            return labels
    return [f"{index + 1}: {label}" for index, label in enumerate(labels)]


def _label(title: str, *parts: str) -> str:
    told = ", ".join(part for part in parts if part)
    return f"{title} ({told})" if told else title


def _state(result: Results) -> str:
    parts = [result.method.preset]
    if result.frames != "perturbed":
        parts.append(f"{result.frames} frames")
    if result.budget.get("seconds"):
        parts.append(f"{result.budget['seconds']:g} s")
    if result.budget.get("steps"):
        parts.append(f"{result.budget['steps']} steps")
    return ", ".join(parts)


def refuse_unlike(runs: Sequence[MethodRuns]) -> None:
    """Refuse results whose difference would not be that of the methods.

    Raises:
        UsageError: protocols, captures, capture or split digests, the masks that are scored, or the
            choice of training frames differ; the message says which.
    """
    everything = [(run.label, result) for run in runs for result in run.seeds.values()]
    label, reference = everything[0]
    for other_label, other in everything[1:]:
        between = f"{label} and {other_label}"
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
                remedy="Compare runs with the same --frames.",
            )
        _same_captures(between, reference, other)


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
        twin = theirs[identifier]
        if capture.exact_masks != twin.exact_masks:
            problem, field = "different masks (exact and estimated)", "exact_masks"
        elif capture.digest != twin.digest:
            problem, field = "different data", "digest"
        elif capture.split_digest != twin.split_digest:
            problem, field = "different splits", "split_digest"
        elif [f.frame for f in capture.frames] != [f.frame for f in twin.frames]:
            problem, field = "different test frames", "frames"
        else:
            continue
        raise UsageError(
            f"{between} were evaluated on {problem} under the name {identifier}"
            + differing_makers(capture, twin),
            where=identifier,
            field=field,
            remedy="Evaluate both on the same captures with the same splits.",
        )


def common_seeds(first: MethodRuns, second: MethodRuns) -> list[int]:
    """Return the seeds that both have.

    Raises:
        UsageError: there is none.
    """
    seeds = sorted(first.seeds.keys() & second.seeds.keys())
    if not seeds:
        raise UsageError(
            f"{first.label} and {second.label} have no seed in common",
            field="seed",
            remedy="Evaluate both with the same --seed.",
        )
    return seeds


def scopes(results: Results) -> dict[str, dict[str, float]]:
    """Return the sets of captures that are averaged, with the weight of each capture.

    Args:
        results: an evaluation.

    Returns:
        By scope, in the order of tables: `macro` (weights as in the mean over perturbations; all
        captures count the same where none has a perturbation), `single`, `interacting`, and each
        perturbation. Scopes without captures are left out.
    """
    captures = results.captures
    carriers = {
        name: [capture.id for capture in captures if name in capture.perturbations]
        for name in PERTURBATIONS
    }
    carriers = {name: identifiers for name, identifiers in carriers.items() if identifiers}
    macro: dict[str, float] = {}
    for identifiers in carriers.values():
        for identifier in identifiers:
            macro[identifier] = macro.get(identifier, 0.0) + 1 / len(identifiers)
    found = {
        MACRO: macro or {capture.id: 1.0 for capture in captures},
        "single": {capture.id: 1.0 for capture in captures if capture.hands != "both"},
        "interacting": {capture.id: 1.0 for capture in captures if capture.hands == "both"},
    }
    found |= {name: dict.fromkeys(identifiers, 1.0) for name, identifiers in carriers.items()}
    return {name: weights for name, weights in found.items() if weights}


def common_metrics(runs: Sequence[MethodRuns], names: Sequence[str]) -> list[str]:
    """Return those of `names` that every evaluation has."""
    measured = [set(result.metrics) for run in runs for result in run.seeds.values()]
    return [name for name in names if all(name in known for known in measured)]
