"""Tables that need several evaluations: ranks, cost, robustness, severity, bias, seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hwp_bench.analysis.compare import macro_by_seed, rank_methods, verdict
from hwp_bench.analysis.cost import BUDGETS, MethodCost, method_costs
from hwp_bench.analysis.pairing import MethodRuns, common_metrics, group_runs
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.metrics.score import aggregate
from hwp_bench.report.sources import ResultsSource, mean_severity, mean_temporal_weight
from hwp_bench.report.tables import HEADLINE, labels, score_column
from hwp_bench.results import Results
from hwp_bench.results.schema import score_rows
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: Metric of the ranks and of the sentence that says who wins.
METRIC = HEADLINE[0]
_GB = 1e9


def rank_table(runs: Sequence[MethodRuns]) -> Table:
    """Return one row a method, best first: rank with interval, score, what it is behind, ties.

    Args:
        runs: the methods, on the same data.

    Raises:
        UsageError: two methods have no seed in common.
    """
    ranking = rank_methods(runs, METRIC)
    facts = metric_facts(METRIC)
    others = [name for name in common_metrics(runs, HEADLINE) if name != METRIC]
    by_label = {run.label: run for run in runs}
    columns = [
        Column("Method"),
        Column("Rank", 0, group="Rank"),
        Column("95 %", group="Rank"),
        score_column(METRIC),
        Column("Difference", facts.digits, group="Less the first"),
        Column("Low", facts.digits, group="Less the first"),
        Column("High", facts.digits, group="Less the first"),
        Column("Ties"),
        *(score_column(name) for name in others),
        Column("Seeds", 0),
    ]
    rows: list[tuple[Cell, ...]] = []
    for item in ranking.ranks:
        behind = item.behind
        rows.append(
            (
                item.standing.label,
                item.rank,
                f"{item.best}" if item.best == item.worst else f"{item.best} to {item.worst}",
                item.standing.mean,
                *((behind.value, behind.low, behind.high) if behind else (None, None, None)),
                item.standing.ties,
                *(float(macro_by_seed(by_label[item.standing.label], n).mean()) for n in others),
                item.standing.seeds,
            )
        )
    notes = (
        verdict(ranking),
        "Macro means. Interval of a rank: what a method's significant differences leave "
        "(Bonferroni over its pairs), so that each interval holds with 95 %. Methods that share "
        "a letter are tied (Holm over all pairs).",
    )
    return Table(f"Ranks by {facts.label}", tuple(columns), tuple(rows), notes)


def winner_note(results: Sequence[Results]) -> str | None:
    """Return the sentence that says who wins; None where there is nothing to compare.

    Args:
        results: on the same data.
    """
    try:
        runs = group_runs(results)
        if len(runs) < 2 or not common_metrics(runs, [METRIC]):
            return None
        return verdict(rank_methods(runs, METRIC))
    except UsageError as error:
        # The same run twice, or no seed in common: the tables can be shown all the same.
        return f"Nobody is named as the winner: {error.problem}."


def cost_table(runs: Sequence[MethodRuns]) -> Table:
    """Return one row a method: its score, the score after fixed times, seconds and memory.

    Args:
        runs: the methods, on the same data.
    """
    facts = metric_facts(METRIC)
    costs = method_costs(runs, METRIC, budgets=BUDGETS)
    scores = [float(macro_by_seed(run, METRIC).mean()) for run in runs]
    budgets = list(costs[0].at)
    unit = f"{facts.label} [{facts.unit}]"
    columns = [
        Column("Method"),
        Column("Test", facts.digits, True, unit),
        *(Column(f"{budget:g} s", facts.digits, True, f"{unit} after") for budget in budgets),
        Column("Fit [s]", 1, False, "Cost"),
        Column("One core [s]", 1, False, "Cost"),
        Column("Memory [GB]", 2, False, "Cost"),
        Column("Render [frames/s]", 1, True, "Cost"),
        Column("Front"),
    ]
    rows = [
        (
            cost.label,
            score,
            *(cost.at[budget] for budget in budgets),
            cost.fit_seconds,
            cost.cpu_seconds,
            cost.peak_memory / _GB if cost.peak_memory else None,
            cost.frames_per_second,
            "yes" if on_front(cost, score, costs, scores) else None,
        )
        for cost, score in zip(costs, scores, strict=True)
    ]
    notes = (
        "Test: macro mean. After a time: validation frames, outside the method's clock. One core: "
        "CPU seconds of the fit, all threads added up; the seconds that one core would need.",
        "Front: no other method has at least this test score in as few seconds. Means over "
        "captures and seeds; memory is the largest. Seconds compare on one machine only.",
    )
    return Table("Accuracy and cost", tuple(columns), tuple(rows), notes)


def on_front(
    cost: MethodCost, score: float, costs: Sequence[MethodCost], scores: Sequence[float]
) -> bool:
    """Return whether no other method is at least as good in as few seconds, and better in one.

    Args:
        cost: of the method.
        score: its test score, larger is better.
        costs: of all methods.
        scores: their test scores.
    """
    if cost.fit_seconds is None:
        return False
    for other, theirs in zip(costs, scores, strict=True):
        if other is cost or other.fit_seconds is None:
            continue
        as_good = theirs >= score and other.fit_seconds <= cost.fit_seconds
        if as_good and (theirs > score or other.fit_seconds < cost.fit_seconds):
            return False
    return True


#: Metrics of the robustness table.
ROBUST = HEADLINE[:3]
#: Captures whose mean severity is below these count as of low, of medium, else of high level.
LEVELS = ((1.0, "Low"), (2.0, "Medium"), (5.1, "High"))


def robustness_table(sources: Sequence[ResultsSource], base: str | None = None) -> Table:
    """Return what perturbed frames cost each method, and how much of that it wins back.

    Args:
        sources: for every method an evaluation on the perturbed frames and one on the clean
            ones (`--frames clean`), the clean-data oracle; seeds are averaged.
        base: name of the method that the share of the gap is counted from.

    Raises:
        UsageError: no method was evaluated on both, or none is called `base`.
    """
    runs = group_runs([source.results for source in sources])
    perturbed = [run for run in runs if run.first.frames == "perturbed"]
    pairs = [(run, clean) for run in perturbed if (clean := _oracle(run, runs)) is not None]
    if not pairs:
        raise UsageError(
            "no method was evaluated on perturbed and on clean frames",
            field="RESULTS",
            remedy="Give the results of `evaluate` and of `evaluate --frames clean`.",
        )
    start = _base(perturbed, base)
    names = common_metrics(runs, ROBUST)
    columns = [Column("Method")]
    for name in names:
        label = metric_facts(name).label
        column = score_column(name)
        columns += [
            Column("Perturbed", column.digits, column.higher_is_better, label),
            Column("Clean", column.digits, group=label),
            Column("Change [%]", 1, group=label),
            Column("Gap closed [%]", 1, True, label),
        ]
    rows = []
    for run, clean in pairs:
        cells: list[Cell] = [run.first.method.title]
        for name in names:
            score, oracle = _macro(run, name), _macro(clean, name)
            change = 100 * (score - oracle) / abs(oracle) if oracle else None
            cells += [score, oracle, change, _closed(run, start, name, score, oracle)]
        rows.append(tuple(cells))
    notes = (
        "Clean: the same method fitted on the clean frames of the same captures, the most that "
        "it can reach. Change: perturbed against clean.",
        "Gap closed: of the way from "
        + (f"{start.first.method.title} on perturbed frames" if start else "a base (--base)")
        + " to that oracle, the share that the method goes. Macro means.",
    )
    return Table("Robustness", tuple(columns), tuple(rows), notes)


def _oracle(run: MethodRuns, runs: Sequence[MethodRuns]) -> MethodRuns | None:
    """Return the runs of the same method in the same state on clean frames of the same captures."""
    data = [(c.id, c.split_digest) for c in run.first.captures]
    for other in runs:
        same = other.first.method == run.first.method and other.first.budget == run.first.budget
        captures = [(c.id, c.split_digest) for c in other.first.captures]
        if other.first.frames == "clean" and same and captures == data:
            return other
    return None


def _base(perturbed: Sequence[MethodRuns], name: str | None) -> MethodRuns | None:
    if name is None:
        return None
    for run in perturbed:
        if run.first.method.name == name:
            return run
    known = ", ".join(sorted({run.first.method.name for run in perturbed}))
    raise UsageError(
        f"no result on perturbed frames is of {name!r}", field="--base", remedy=f"Given: {known}."
    )


def _closed(
    run: MethodRuns, start: MethodRuns | None, name: str, score: float, oracle: float
) -> float | None:
    """Return 100 (score - base) / (oracle - base); None without a base or a gap."""
    if start is None or start is run:
        return None
    base = _macro(start, name)
    gap = oracle - base if metric_facts(name).higher_is_better else base - oracle
    return 100 * (score - base) / (oracle - base) if gap > 0 else None


def _macro(run: MethodRuns, name: str) -> float:
    return float(macro_by_seed(run, name).mean())


def severity_table(sources: Sequence[ResultsSource], captures: Mapping[str, CaptureInfo]) -> Table:
    """Return one row a perturbation, level of severity and method.

    Args:
        sources: the evaluations.
        captures: by digest, as `report.sources.find_captures` gives them.

    Raises:
        UsageError: the severity of no capture is known.
    """
    results = [source.results for source in sources]
    names = [name for name in HEADLINE[:3] if all(name in r.metrics for r in results)]
    cells: dict[tuple[int, int], dict[int, list[list[float]]]] = {}
    for place, result in enumerate(results):
        means = aggregate(score_rows(result)).overall.captures
        for capture in result.captures:
            if capture.digest not in captures:
                continue
            test = [frame.frame for frame in capture.frames]
            found = mean_severity(captures[capture.digest], test, perturbed_only=True)
            for name, value in found.items():
                key = (PERTURBATIONS.index(name), round(value))
                own = [means[capture.id][metric] for metric in names]
                cells.setdefault(key, {}).setdefault(place, []).append(own)
    if not cells:
        raise UsageError(
            "the severity of none of these captures is known",
            field="--captures",
            remedy="Name the capture folders, or render the suite on this machine.",
        )
    columns = [Column("Perturbation"), Column("Severity", 0), Column("Captures", 0)]
    columns += [Column("Method"), *(score_column(name) for name in names)]
    rows: list[tuple[Cell, ...]] = []
    breaks = []
    titles = labels(results)
    for (index, level), methods in sorted(cells.items()):
        breaks.append(len(rows))
        for place, scores in methods.items():
            heading = perturbation(PERTURBATIONS[index]).heading
            means_over = [float(value) for value in np.mean(scores, axis=0)]
            rows.append((heading, level, len(scores), titles[place], *means_over))
    note = (
        "Severity: mean over the frames to learn from that show the perturbation, rounded. The "
        "test frames that are scored show none."
    )
    return Table("By severity", tuple(columns), tuple(rows), (note,), breaks=tuple(breaks[1:]))


def bias_rows(
    sources: Sequence[ResultsSource], captures: Mapping[str, CaptureInfo], metrics: Sequence[str]
) -> list[tuple[Cell, ...]]:
    """Return the rows of the bias table: capture, level, severity, method, scores, mean weight.

    Captures are ordered by their severity, unknown ones last.
    """
    rows: list[tuple[Any, ...]] = []
    titles = labels([source.results for source in sources])
    for source, title in zip(sources, titles, strict=True):
        means = aggregate(score_rows(source.results)).overall.captures
        for capture in source.results.captures:
            weight = mean_temporal_weight(source, capture.id)
            if weight is None:
                continue
            info = captures.get(capture.digest)
            test = [frame.frame for frame in capture.frames]
            known = mean_severity(info, test) if info else {}
            severity = max(known.values(), default=None)
            scores = [means[capture.id].get(name) for name in metrics]
            rows.append((capture.id, _level(severity), severity, title, *scores, 1000 * weight))
    return sorted(rows, key=lambda row: (row[2] is None, row[2] or 0.0, row[0]))


def _level(severity: float | None) -> str | None:
    """Return the word for a mean severity."""
    return None if severity is None else next(word for top, word in LEVELS if severity < top)


def bias_table(sources: Sequence[ResultsSource], captures: Mapping[str, CaptureInfo]) -> Table:
    """Return the mean temporal weight against the perturbation level, a row a capture.

    Raises:
        UsageError: no evaluation has temporal weights.
    """
    names = [name for name in HEADLINE if all(name in s.results.metrics for s in sources)]
    rows = bias_rows(sources, captures, names)
    if not rows:
        raise refused_bias()
    columns = [Column("Capture"), Column("Disturbance"), Column("Severity", 2), Column("Method")]
    columns += [score_column(name) for name in names]
    columns.append(Column("Mean temporal weight [1e-3]", 3))
    return Table("Bias strength", tuple(columns), tuple(rows), (LEVEL_NOTE,), ranked=False)


#: The levels of the bias table.
LEVEL_NOTE = (
    "Severity: the strongest perturbation's mean over the frames to learn from, 0 to 5; low is "
    "below 1, medium below 2. Weights: mean over sides and training frames."
)


def refused_bias() -> UsageError:
    """Return the error of results without temporal weights."""
    return UsageError(
        "none of these methods left temporal weights",
        field="RESULTS",
        remedy="A method leaves them in diagnostics/temporal.json; docs/tables.md says how.",
    )


def seeds_table(sources: Sequence[ResultsSource]) -> Table:
    """Return one row a method: mean and standard deviation over seeds of the macro mean."""
    runs = group_runs([source.results for source in sources])
    names = common_metrics(runs, HEADLINE)
    columns = [Column("Method"), Column("Seeds", 0)]
    for name in names:
        column = score_column(name)
        columns += [
            Column("Mean", column.digits, column.higher_is_better, column.title),
            Column("Deviation", column.digits + 2, group=column.title),
        ]
    rows = []
    for run in runs:
        cells: list[Cell] = [run.label, len(run.seeds)]
        for name in names:
            means = macro_by_seed(run, name)
            cells += [float(means.mean()), float(means.std(ddof=1)) if len(means) > 1 else None]
        rows.append(tuple(cells))
    note = "Macro means; the standard deviation is the sample's (n - 1)."
    return Table("Over seeds", tuple(columns), tuple(rows), (note,))
