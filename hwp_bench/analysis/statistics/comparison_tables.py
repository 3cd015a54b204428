"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.analysis.statistics.bootstrap import Estimate
from hwp_bench.analysis.statistics.compare import Difference, Standing
from hwp_bench.analysis.statistics.pairing import MACRO
from hwp_bench.base.tables import Column, Table
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

_INTERVAL = (
    "95 % intervals, P and p: paired bootstrap over captures, then seeds and blocks of frames, "
    "read with Student's t (docs/statistics.md)."
)
#: Said under a table that has such scopes.
ONE_CAPTURE = (
    "Scopes of one capture speak only of further frames of that capture, not of further captures."
)


def scope_title(scope: str) -> str:
    """Return the heading of a scope."""
    if scope in PERTURBATIONS:
        return perturbation(scope).heading
    return {MACRO: "Macro", "single": "Single", "interacting": "Interacting"}.get(scope, scope)


def estimate_columns(metric: str) -> tuple[Column, ...]:
    """Return the columns of an estimate in a metric: value, interval."""
    facts = metric_facts(metric)
    unit = f" [{facts.unit}]" if facts.unit else ""
    return (
        Column(f"Difference{unit}", facts.digits),
        Column("Low", facts.digits, group="95 % interval"),
        Column("High", facts.digits, group="95 % interval"),
    )


def estimate_cells(estimate: Estimate) -> tuple[float | None, ...]:
    """Return the cells of `estimate_columns`."""
    return (estimate.value, estimate.low, estimate.high)


def standings_table(metric: str, found: Sequence[Standing]) -> Table:
    """Return one row a method, best first."""
    facts = metric_facts(metric)
    title = f"{facts.label} [{facts.unit}]" if facts.unit else facts.label
    columns = (
        Column("Method"),
        Column(title, facts.digits, facts.higher_is_better),
        Column("Ties"),
        Column("Seeds", 0),
        Column("Spread over seeds", facts.digits + 1),
    )
    rows = tuple((s.label, s.mean, s.ties, s.seeds, s.seed_deviation) for s in found)
    note = (
        "Macro mean. Methods that share a letter do not differ significantly (Holm over the "
        "pairs, 5 %); the spread is the standard deviation of the mean over seeds."
    )
    return Table(f"{facts.label}: methods", columns, rows, (note,))


def differences_table(metric: str, found: Sequence[Difference]) -> Table:
    """Return one row a pair and scope."""
    facts = metric_facts(metric)
    columns = (
        Column("First"),
        Column("Second"),
        Column("Scope"),
        Column("Captures", 0),
        *estimate_columns(metric),
        Column("P(first better)", 3),
        Column("p", 4),
        Column("p (Holm)", 4),
        Column("Detectable", facts.digits),
    )
    rows = tuple(
        (
            item.first,
            item.second,
            scope_title(item.scope),
            item.estimate.captures,
            *estimate_cells(item.estimate),
            item.better,
            item.estimate.p,
            item.p_adjusted,
            item.estimate.detectable,
        )
        for item in found
    )
    direction = "above" if facts.higher_is_better else "below"
    notes = [
        f"First less second; {direction} 0 the first is better. {_INTERVAL}",
        "p (Holm): over the perturbations of a pair, and over the pairs for the macro mean. "
        "Detectable: the true difference that such a comparison finds with 80 % probability.",
    ]
    if any(item.estimate.captures == 1 for item in found):
        notes.append(ONE_CAPTURE)
    return Table(f"{facts.label}: differences", columns, rows, tuple(notes))
