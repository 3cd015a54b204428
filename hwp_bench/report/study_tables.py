"""Tables that need several evaluations: ranks, cost, robustness, severity, bias, seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hwp_bench.analysis.columns import Filled, block_breaks, score_column, score_title, table_of
from hwp_bench.analysis.compare import Ranking, macro_by_seed, macro_mean, rank_methods, verdict
from hwp_bench.analysis.cost import BUDGETS, MethodCost, machine_notes, method_costs
from hwp_bench.analysis.discrimination import item_statistics
from hwp_bench.analysis.pairing import (
    MethodRuns,
    common_metrics,
    common_seeds,
    group_runs,
    refuse_unlike,
)
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.metrics.score import aggregate
from hwp_bench.report.sources import (
    ResultsSource,
    mean_severity,
    mean_temporal_weight,
    rank_with_severity,
)
from hwp_bench.report.tables import HEADLINE, labels, over_seeds
from hwp_bench.results import Results
from hwp_bench.results.schema import score_rows
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: Metric of the ranks and of the sentence that says who wins.
METRIC = HEADLINE[0]


def rank_table(runs: Sequence[MethodRuns], ranking: Ranking | None = None) -> Table:
    """Return one row per method, best first: rank, score, distance from the first, ties.

    `ranking` is that of the runs by `METRIC`, where it is known already.
    """
    ranking = ranking or rank_methods(runs, METRIC)
    facts = metric_facts(METRIC)
    others = [name for name in common_metrics(runs, HEADLINE) if name != METRIC]
    by_label = {run.label: run for run in runs}
    ranks = ranking.ranks
    behind = [(b.value, b.low, b.high) if (b := item.behind) else (None,) * 3 for item in ranks]
    ends = zip(("Difference", "Low", "High"), zip(*behind, strict=True), strict=True)
    columns: list[Filled] = [
        (Column("Method"), [item.standing.label for item in ranks]),
        (Column("Rank", 0, group="Rank"), [item.rank for item in ranks]),
        (Column("95 %", group="Rank"), [item.interval for item in ranks]),
        (score_column(METRIC), [item.standing.mean for item in ranks]),
        *((Column(title, facts.digits, group="Less the first"), own) for title, own in ends),
        (Column("Ties"), [item.standing.ties for item in ranks]),
    ]
    for name in others:
        means = [macro_mean(by_label[item.standing.label], name) for item in ranks]
        columns.append((score_column(name), means))
    columns.append((Column("Seeds", 0), [len(item.standing.seeds) for item in ranks]))
    notes = (
        verdict(ranking),
        "Macro means. Interval of a rank: what a method's significant differences leave "
        "(Bonferroni over its pairs), so that each interval holds with 95 %. Methods that share "
        "a letter are tied (Holm over all pairs).",
    )
    return table_of(f"Ranks by {facts.label}", columns, notes)


def winner_note(results: Sequence[Results]) -> str | None:
    """Return the sentence that says who wins; None where there is nothing to compare."""
    try:
        runs = group_runs(results)
        if len(runs) < 2 or not common_metrics(runs, [METRIC]):
            return None
        return verdict(rank_methods(runs, METRIC))
    except UsageError as error:
        # The same run twice, or no seed in common: the tables can be shown all the same.
        return f"Nobody is named as the winner: {error.problem}."


def cost_table(runs: Sequence[MethodRuns]) -> Table:
    """Return one row per method: its score, the score after fixed times, seconds and memory."""
    facts = metric_facts(METRIC)
    costs = method_costs(runs, METRIC, budgets=BUDGETS)
    scores = [macro_mean(run, METRIC) for run in runs]
    unit = score_title(METRIC)
    front = [on_front(*one, costs, scores) for one in zip(costs, scores, strict=True)]
    columns: list[Filled] = [
        (Column("Method"), [cost.label for cost in costs]),
        (Column("Test", facts.digits, True, unit), scores),
    ]
    for budget in costs[0].at:
        head = Column(f"{budget:g} s", facts.digits, True, f"{unit} after")
        columns.append((head, [cost.at[budget] for cost in costs]))
    columns += [
        (Column("Fit [s]", 1, False, "Cost"), [cost.fit_seconds for cost in costs]),
        (Column("One core [s]", 1, False, "Cost"), [cost.cpu_seconds for cost in costs]),
        (Column("Memory [GB]", 2, False, "Cost"), [cost.peak_gb for cost in costs]),
        (Column("Render [frames/s]", 1, True, "Cost"), [one.frames_per_second for one in costs]),
        (Column("Front"), ["yes" if first else None for first in front]),
    ]
    notes = (
        "Test: macro mean. After a time: validation frames, outside the method's clock. One core: "
        "CPU seconds of the fit, all threads added up; the seconds that one core would need.",
        "Front: no other method has at least this test score in as few seconds. Means over "
        "captures and seeds; memory is the largest. Seconds compare on one machine only.",
    )
    results = [result for run in runs for result in run.seeds.values()]
    return table_of("Accuracy and cost", columns, (*notes, *machine_notes(results)))


def on_front(
    cost: MethodCost, score: float, costs: Sequence[MethodCost], scores: Sequence[float]
) -> bool:
    """Return whether no other method is at least as good in as few seconds, and better in one."""
    if cost.fit_seconds is None:
        return False
    mine = (-cost.fit_seconds, score)
    others = [
        (-other.fit_seconds, theirs)
        for other, theirs in zip(costs, scores, strict=True)
        if other is not cost and other.fit_seconds is not None
    ]
    return not any(o != mine and o[0] >= mine[0] and o[1] >= mine[1] for o in others)


#: Metrics of the robustness table.
ROBUST = HEADLINE[:3]
#: Captures whose mean severity is below these count as of low, of medium, else of high level.
LEVELS = ((1.0, "Low"), (2.0, "Medium"), (5.1, "High"))


def robustness_table(sources: Sequence[ResultsSource], base: str | None = None) -> Table:
    """Return the loss of each method by perturbed frames, and the share of it that it recovers."""
    runs = group_runs([source.results for source in sources])
    perturbed = [run for run in runs if run.first.frames == "perturbed"]
    triples = [
        _over_common_seeds(run, clean, _base(perturbed, base, run))
        for run in perturbed
        if (clean := _oracle(run, runs)) is not None
    ]
    if not triples:
        raise UsageError(
            "no method was evaluated on perturbed and on clean frames",
            field="RESULTS",
            remedy="Give the results of `evaluate` and of `evaluate --train-on clean`.",
        )
    start = next((below for _, _, below in triples if below), None)
    names = common_metrics(runs, ROBUST)
    columns: list[Filled] = [
        (Column("Method"), labels([run.first for run, _, _ in triples], seeds=False))
    ]
    for name in names:
        label, head = metric_facts(name).label, score_column(name)
        bases = [macro_mean(below, name) if below else None for _, _, below in triples]
        scores = [(macro_mean(run, name), macro_mean(clean, name)) for run, clean, _ in triples]
        changes = [100 * (score - best) / abs(best) if best else None for score, best in scores]
        closed = [
            None if run is below else _closed(floor, *own, higher=bool(head.higher_is_better))
            for (run, _, below), own, floor in zip(triples, scores, bases, strict=True)
        ]
        perturbed_head = Column("Perturbed", head.digits, head.higher_is_better, label)
        columns += [
            (perturbed_head, [score for score, _ in scores]),
            (Column("Clean", head.digits, group=label), [best for _, best in scores]),
            (Column("Change [%]", 1, group=label), changes),
            (Column("Gap closed [%]", 1, True, label), closed),
        ]
    notes = (
        "Clean: the same method fitted on the clean frames of the same captures, the most that "
        "it can reach. Change: perturbed against clean.",
        "Gap closed: of the way from "
        + (f"{start.first.method.title} on perturbed frames" if start else "a base (--baseline)")
        + " to that oracle, the share that the method goes. Of several bases, the one with its "
        "budget counts. Macro means.",
    )
    return table_of("Robustness", columns, notes)


def _over_common_seeds(
    run: MethodRuns, clean: MethodRuns, base: MethodRuns | None
) -> tuple[MethodRuns, MethodRuns, MethodRuns | None]:
    """Return the three with the seeds that all have; a run that is its own base stays that."""

    def kept(one: MethodRuns, seeds: Sequence[int]) -> MethodRuns:
        return replace(one, seeds={seed: one.seeds[seed] for seed in seeds})

    seeds = common_seeds(run, clean)
    if base is not None:
        seeds = common_seeds(kept(run, seeds), base)
    short = kept(run, seeds)
    below = short if base is run else base and kept(base, seeds)
    return short, kept(clean, seeds), below


def _oracle(run: MethodRuns, runs: Sequence[MethodRuns]) -> MethodRuns | None:
    """Return the runs of the same method in the same state on clean frames of the same captures."""

    def state(result: Results) -> tuple[object, ...]:
        captures = [(c.id, c.split_digest) for c in result.captures]
        return result.method, result.budget, captures

    same = (one for one in runs if state(one.first) == state(run.first))
    return next((one for one in same if one.first.frames == "clean"), None)


def _base(perturbed: Sequence[MethodRuns], name: str | None, run: MethodRuns) -> MethodRuns | None:
    """Return the runs of the named method: of several, the one with a method's own budget."""
    if name is None:
        return None
    named = [one for one in perturbed if one.first.method.name == name]
    if any(one is run for one in named):
        return run
    alike = [one for one in named if one.first.budget == run.first.budget]
    if named:
        return next((found[0] for found in (named, alike) if len(found) == 1), None)
    known = ", ".join(sorted({run.first.method.name for run in perturbed}))
    raise UsageError(
        f"no result on perturbed frames is of {name!r}",
        field="--baseline",
        remedy=f"Given: {known}.",
    )


def _closed(base: float | None, score: float, oracle: float, *, higher: bool) -> float | None:
    """Return 100 (score - base) / (oracle - base); None without a base or a gap."""
    if base is None or (oracle <= base if higher else oracle >= base):
        return None
    return 100 * (score - base) / (oracle - base)


def severity_table(sources: Sequence[ResultsSource], captures: Mapping[str, CaptureInfo]) -> Table:
    """Return one row per perturbation, severity level and method."""
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
            field="--capture",
            remedy="Name the capture folders, or render the suite on this machine.",
        )
    titles = labels(results)
    shown = [
        (index, level, titles[place], scores)
        for (index, level), methods in sorted(cells.items())
        for place, scores in methods.items()
    ]
    headings = [perturbation(PERTURBATIONS[index]).heading for index, _, _, _ in shown]
    columns: list[Filled] = [
        (Column("Perturbation"), headings),
        (Column("Severity", 0), [level for _, level, _, _ in shown]),
        (Column("Captures", 0), [len(scores) for _, _, _, scores in shown]),
        (Column("Method"), [title for _, _, title, _ in shown]),
    ]
    for place, name in enumerate(names):
        over = [float(np.mean(scores, axis=0)[place]) for _, _, _, scores in shown]
        columns.append((score_column(name), over))
    note = (
        "Severity: mean over the frames to learn from that show the perturbation, rounded. The "
        "test frames that are scored show none."
    )
    breaks = block_breaks([(index, level) for index, level, _, _ in shown])
    return table_of("By severity", columns, [note], breaks=breaks)


def _bias_rows(
    sources: Sequence[ResultsSource], captures: Mapping[str, CaptureInfo], metrics: Sequence[str]
) -> list[tuple[Cell, ...]]:
    """Return rows: capture, level, severity, method, scores, mean weight, and its correlation.

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
            rank = rank_with_severity(source, capture.id, info)
            row = (capture.id, _level(severity), severity, title, *scores, 1000 * weight, rank)
            rows.append(row)
    return sorted(rows, key=lambda row: (row[2] is None, row[2] or 0.0, row[0]))


def _level(severity: float | None) -> str | None:
    """Return the word for a mean severity."""
    return None if severity is None else next(word for top, word in LEVELS if severity < top)


def bias_table(
    sources: Sequence[ResultsSource],
    captures: Mapping[str, CaptureInfo],
    metrics: Sequence[str] | None = None,
) -> Table:
    """Return the mean temporal weight and the perturbation level: a row per capture and method.

    Args:
        metrics: of the scores; None: those of `HEADLINE` that all have.
    """
    names = metrics
    if names is None:
        names = [name for name in HEADLINE if all(name in s.results.metrics for s in sources)]
    rows = _bias_rows(sources, captures, names)
    if not rows:
        raise UsageError(
            "none of these methods left temporal weights",
            field="RESULTS",
            remedy="A method leaves them in its diagnostics; docs/methods.md says how.",
        )
    columns = [Column("Capture"), Column("Disturbance"), Column("Severity", 2), Column("Method")]
    columns += [score_column(name) for name in names]
    columns.append(Column("Mean temporal weight [1e-3]", 3))
    columns.append(Column("Rank correlation", 2))
    notes = (LEVEL_NOTE, RANK_NOTE)
    table = Table("Bias strength", tuple(columns), tuple(rows), notes, ranked=False)
    return over_seeds(table, [source.results for source in sources])


#: The levels of the bias table.
LEVEL_NOTE = (
    "Severity: the strongest perturbation's mean over the frames to learn from, 0 to 5; low is "
    "below 1, medium below 2. Weights: mean over sides and training frames."
)
#: What the last column of the bias table is.
RANK_NOTE = (
    "Rank correlation: Spearman's, of the weights of frames with the sum of their severities."
)


def seeds_table(sources: Sequence[ResultsSource]) -> Table:
    """Return one row per method: mean and standard deviation over seeds of the macro mean."""
    runs = group_runs([source.results for source in sources])
    names = common_metrics(runs, HEADLINE)
    columns: list[Filled] = [
        (Column("Method"), [run.label for run in runs]),
        (Column("Seeds", 0), [len(run.seeds) for run in runs]),
    ]
    for name in names:
        head = score_column(name)
        means = [macro_by_seed(run, name) for run in runs]
        spread = [float(own.std(ddof=1)) if len(own) > 1 else None for own in means]
        columns += [
            (
                Column("Mean", head.digits, head.higher_is_better, head.title),
                [float(own.mean()) for own in means],
            ),
            (Column("Deviation", head.digits + 2, group=head.title), spread),
        ]
    note = "Macro means; the standard deviation is the sample's (n - 1)."
    return table_of("Over seeds", columns, [note])


def discrimination_table(runs: Sequence[MethodRuns], base: str | None = None) -> Table:
    """Return one row per metric and capture: how well it separates methods, best first.

    `base` names a method whose scores are the ceiling, such as the truth as an entry; otherwise the
    ceiling is the score of identical images.
    """
    refuse_unlike(runs)
    ceilings = [run for run in runs if run.first.method.name == base]
    methods = [run for run in runs if run not in ceilings]
    if base is not None and not ceilings:
        raise UsageError(f"no result is of {base!r}", field="--baseline")
    if len(methods) < 2:
        raise UsageError("several methods are needed", field="RESULTS")
    rows: list[tuple[Cell, ...]] = []
    breaks: list[int] = []
    for name in common_metrics(runs, HEADLINE):
        facts = metric_facts(name)
        top = {c.id: facts.perfect for c in runs[0].first.captures}
        if ceilings:
            top = {one: _seed_means(ceilings[0], one, name).mean() for one in top}
        scores = {one: [_seed_means(run, one, name) for run in methods] for one in top}
        own = item_statistics(scores, top, facts.penalty, higher=facts.higher_is_better)
        own.sort(key=lambda item: -(item.ratio if item.ratio is not None else -1.0))
        breaks.append(len(rows))
        for item in own:
            spreads = (item.between, item.within, item.ratio, item.reliability, item.agreement)
            rows.append((facts.label, item.capture, *spreads, item.best, item.saturation))
    columns = (
        Column("Metric"),
        Column("Capture"),
        Column("Methods", 4, group="Spread between"),
        Column("Seeds", 4, group="Spread between"),
        Column("Ratio", 1),
        Column("ICC", 3),
        Column("Agreement", 2),
        Column("Best", 4),
        Column("Saturation", 3),
    )
    return Table(
        "Discrimination",
        columns,
        tuple(rows),
        _DISCRIMINATION,
        ranked=False,
        breaks=tuple(breaks[1:]),
    )


_DISCRIMINATION = (
    "Standard deviations between methods and between seeds of one method (one-way analysis of "
    "variance); Ratio: the first over the second; ICC: the share of the variance that is methods'.",
    "Agreement: correlation over methods with the mean of the other captures. Saturation: share of "
    "the way from a failed frame's score to the ceiling that the best method has gone.",
)


def _seed_means(run: MethodRuns, capture: str, metric: str) -> np.ndarray:
    """(S,) mean over frames of a capture, one a seed."""
    return run.values(capture, metric, sorted(run.seeds)).mean(axis=1)
