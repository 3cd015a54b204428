"""Accuracy against time of all rows of a table: the plot of the board's page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from hwp_bench.analysis.cost.analysis import analyse_cost
from hwp_bench.analysis.statistics.pairing import group_runs
from hwp_bench.base.errors import UsageError
from hwp_bench.leaderboard.board_rows import BoardRow
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.figures import draw_pareto
from hwp_bench.report.page.elements import inline_svg
from hwp_bench.report.ranking_tables import METRIC


@dataclass(frozen=True)
class CurvePlot:
    """One plot with what its legend needs."""

    #: The plot, an SVG element.
    figure: Markup
    #: Labels of the methods, in the order of their colours.
    methods: Sequence[str]
    #: Labels of those that are on the Pareto front for some time.
    front: Sequence[str]


def curve_plot(rows: Sequence[BoardRow]) -> CurvePlot | None:
    """Draw the mean score of validation frames over the seconds of fitting, and the front.

    Args:
        rows: of one suite and one version of the protocol; those that lack a part of the suite do
            not take part.

    Returns:
        The plot, best row first in its legend; None where no row left a curve, or where one
        submitted twice cannot be told apart.
    """
    whole = sorted((row for row in rows if row.whole), key=lambda row: -row.scores[METRIC])
    try:
        runs = group_runs([results for row in whole for results in row.compared])
        cost = analyse_cost(runs, METRIC) if runs else None
    except UsageError:
        return None
    if cost is None:
        return None
    order = {curve.label: index for index, curve in enumerate(cost.curves)}
    figure = draw_pareto(cost.curves, cost.front, METRIC, order)
    suite = whole[0].first.suite
    title = f"{metric_facts(METRIC).label} over seconds of fitting on {suite}"
    leading = {part.label for part in cost.front}
    return CurvePlot(
        inline_svg(figure, title), list(order), [label for label in order if label in leading]
    )
