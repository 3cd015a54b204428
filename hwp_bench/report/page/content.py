"""Everything that a report shows, gathered from results before a word of HTML is written."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from markupsafe import Markup

from hwp_bench.analysis.cost.analysis import CostAnalysis, analyse_cost
from hwp_bench.analysis.statistics.bootstrap import bootstrap_mean
from hwp_bench.analysis.statistics.compare import compare, macro_by_seed, standings
from hwp_bench.analysis.statistics.comparison_tables import differences_table, standings_table
from hwp_bench.analysis.statistics.pairing import MethodRuns, group_runs, refuse_unlike, scopes
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Table
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.avatar_pages import AvatarPages
from hwp_bench.report.evaluation_tables import all_tables, same_data
from hwp_bench.report.figures import Bar, draw_bars, draw_pareto
from hwp_bench.report.free_view_table import free_view_table
from hwp_bench.report.page.album import Album, frame_sheets, free_view_sheet, mask_sheet
from hwp_bench.report.page.elements import inline_svg, to_html
from hwp_bench.report.page.strips import StripMethod, strip_plot
from hwp_bench.report.provenance import provenance
from hwp_bench.report.ranking_tables import rank_table
from hwp_bench.report.sources import ResultsSource, find_captures, sound_temporal_weights
from hwp_bench.report.study_tables import bias_table, robustness_table, seeds_table, severity_table
from hwp_bench.results import Results
from hwp_bench.results.schema import add_isolation_note
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: The metric of the plots and of the summary sentence.
HEADLINE = "psnr"
#: Name of the plain baseline, which others are compared with where it is among them.
PLAIN = "plain"


@dataclass(frozen=True)
class CaptureSection:
    """One capture on the page."""

    #: Its id.
    id: str
    #: Its facts, in words.
    facts: str
    #: Its strip.
    strip: Markup
    #: Whether severities are known.
    severities: bool
    #: Sheets of worst, median and best frame: (method, data URI).
    frames: Sequence[tuple[str, str]]
    #: Sheets of views from all around: (method, data URI).
    views: Sequence[tuple[str, str]]
    #: Sheets of weight masks: (method, data URI, number of masks).
    masks: Sequence[tuple[str, str, int]]
    #: Pages of avatars: (method, address).
    avatars: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class ReportPage:
    """Everything on the page."""

    #: One or two sentences that say what the results say.
    summary: str
    #: Labels of the methods, in the order of their colours.
    methods: Sequence[str]
    #: Tables: the first few of everything, then those that need more.
    tables: Sequence[Markup]
    #: Score over seconds, or None without curves.
    pareto: Markup | None
    #: Tables of accuracy against time.
    cost_tables: Sequence[Markup]
    #: Bars by perturbation, or None where no capture has one.
    bars: Markup | None
    #: Tables of differences with intervals.
    differences: Sequence[Markup]
    #: One entry a capture.
    captures: Sequence[CaptureSection]
    #: One row a result: what it was made with.
    provenance: Sequence[Mapping[str, str]]
    #: Digests of captures, splits and predictions.
    digests: Sequence[Mapping[str, str]]
    #: Images for which the page had no space left.
    left_out: int


def gather_report(
    sources: Sequence[ResultsSource],
    capture_folders: Sequence[str | os.PathLike[str]] = (),
    *,
    base: str | None = None,
    image_bytes: int | None = None,
    avatar_pages: AvatarPages | None = None,
) -> ReportPage:
    """Gather a report.

    Args:
        sources: the evaluations; those on clean frames only enter the robustness table.
        capture_folders: capture folders, for severities.
        base: name of the method that shares of the gap are counted from; None takes the plain
            baseline where it is among them.
        image_bytes: budget of the images; None takes the default.
        avatar_pages: what `copy_avatar_pages` returned of `sources`.

    Raises:
        UsageError: there are no results, or they are of different data or protocols.
    """
    if not sources:
        raise UsageError("results are needed", field="RESULTS")
    results = [source.results for source in sources]
    same_data(results)
    chosen = [s for s in sources if s.results.frames == "perturbed"] or list(sources)
    runs = group_runs([source.results for source in chosen])
    refuse_unlike(runs)
    infos = find_captures(results, capture_folders)
    album = Album() if image_bytes is None else Album(image_bytes)
    order = {run.label: index for index, run in enumerate(runs)}
    start = base or next((r.first.method.name for r in runs if r.first.method.name == PLAIN), None)
    cost = _cost(runs)
    tables = all_tables([source.results for source in chosen])
    shown = [tables["overall"]]
    shown += _optional(lambda: rank_table(runs) if len(runs) > 1 else None)
    shown += [tables[name] for name in ("perturbations", "captures")]
    shown += _optional(lambda: free_view_table([source.results for source in chosen]))
    shown.append(replace(tables["paper"], caption="Protocol paper-wildghand"))
    shown += _optional(
        lambda: robustness_table(sources, start),
        lambda: severity_table(chosen, infos),
        lambda: bias_table(chosen, infos),
        lambda: _seeds(chosen, runs),
    )
    return ReportPage(
        summary=summary_sentence(runs),
        methods=list(order),
        tables=[
            to_html(add_isolation_note(table, results)) for table in shown if len(table.columns) > 1
        ],
        pareto=_pareto(cost, order) if cost else None,
        cost_tables=[to_html(add_isolation_note(table, results)) for table in cost.tables.values()]
        if cost
        else [],
        bars=_bars(runs),
        differences=[to_html(add_isolation_note(table, results)) for table in _differences(runs)],
        captures=_captures(
            chosen, runs, infos, album, _by_label(avatar_pages or {}, sources, runs)
        ),
        provenance=[provenance(result) for result in results],
        digests=[row for result in results for row in _digests(result)],
        left_out=album.left_out,
    )


def summary_sentence(runs: Sequence[MethodRuns]) -> str:
    """Return what the results say, in words."""
    facts = metric_facts(HEADLINE)
    first = runs[0].first
    frames = sum(len(capture.frames) for capture in first.captures)
    means = {run.label: float(macro_by_seed(run, HEADLINE).mean()) for run in runs}
    order = sorted(means, key=lambda name: -means[name])
    best = f"{order[0]} has {means[order[0]]:.{facts.digits}f} {facts.unit}"
    where = f"On {len(first.captures)} captures ({first.suite}, {frames} test frames)"
    failed = sum(c.failed_frames for run in runs for r in run.seeds.values() for c in r.captures)
    tail = f" {failed} frames failed and count with their penalties." if failed else ""
    if len(runs) == 1:
        return f"{where} {best} {facts.label} (macro mean).{tail}"
    found = compare([run for name in order[:2] for run in runs if run.label == name], HEADLINE)
    macro = next(item for item in found if item.scope == "macro").estimate
    text = f"{where} {best} {facts.label} (macro mean), {macro.value:+.{facts.digits}f} "
    text += f"{facts.unit} against {order[1]}, the next"
    if macro.low is not None and macro.high is not None:
        text += f" (95 % interval {macro.low:+.2f} to {macro.high:+.2f}"
        text += ")" if macro.low > 0 or macro.high < 0 else ": not significantly different)"
    return f"{text}.{tail}"


def _cost(runs: Sequence[MethodRuns]) -> CostAnalysis | None:
    try:
        return analyse_cost(runs, HEADLINE)
    except UsageError:
        # No method left a curve; everything else can be shown all the same.
        return None


def _optional(*makers: Callable[[], Table | None]) -> list[Table]:
    """Return the tables that these results hold enough for."""
    found = []
    for make in makers:
        try:
            table = make()
        except UsageError:
            continue
        found += [table] if table is not None else []
    return found


def _seeds(chosen: Sequence[ResultsSource], runs: Sequence[MethodRuns]) -> Table | None:
    return seeds_table(chosen) if any(len(run.seeds) > 1 for run in runs) else None


def _pareto(cost: CostAnalysis, order: Mapping[str, int]) -> Markup:
    figure = draw_pareto(cost.curves, cost.front, HEADLINE, order)
    return inline_svg(figure, f"{metric_facts(HEADLINE).label} over seconds of fitting")


def _bars(runs: Sequence[MethodRuns]) -> Markup | None:
    groups = {}
    for name, weights in scopes(runs[0].first).items():
        if name in PERTURBATIONS:
            groups[perturbation(name).heading] = [
                Bar(
                    index,
                    bootstrap_mean(
                        [run.values(c, HEADLINE, sorted(run.seeds)) for c in weights],
                        list(weights.values()),
                        resamples=2000,
                    ),
                )
                for index, run in enumerate(runs)
            ]
    if not groups:
        return None
    title = f"{metric_facts(HEADLINE).label} by perturbation with 95 % intervals"
    return inline_svg(draw_bars(groups, HEADLINE), title)


def _differences(runs: Sequence[MethodRuns]) -> list[Table]:
    if len(runs) < 2:
        return []
    try:
        found = compare(runs, HEADLINE)
    except UsageError:
        # No seed in common.
        return []
    return [
        standings_table(HEADLINE, standings(runs, HEADLINE, found)),
        differences_table(HEADLINE, found),
    ]


def _by_label(
    pages: AvatarPages, sources: Sequence[ResultsSource], runs: Sequence[MethodRuns]
) -> dict[tuple[str, str], str]:
    """Addresses by label and capture, of the results that stand for their methods."""
    labels = {id(run.first): run.label for run in runs}
    return {
        (labels[id(sources[index].results)], capture): address
        for (index, capture), address in pages.items()
        if id(sources[index].results) in labels
    }


def _captures(
    sources: Sequence[ResultsSource],
    runs: Sequence[MethodRuns],
    infos: Mapping[str, CaptureInfo],
    album: Album,
    pages: Mapping[tuple[str, str], str],
) -> list[CaptureSection]:
    first = {run.label: run.first for run in runs}
    shown = [
        (label, source) for label, f in first.items() for source in sources if source.results is f
    ]
    sections = []
    for capture in runs[0].first.captures:
        info = infos.get(capture.digest)
        methods, frames, views, masks, avatars = [], [], [], [], []
        for index, (label, source) in enumerate(shown):
            own = next(c for c in source.results.captures if c.id == capture.id)
            weights = sound_temporal_weights(source, capture.id)
            methods.append(StripMethod(index, label, own, weights))
            if uri := frame_sheets(source, capture.id, album):
                frames.append((label, uri))
            if uri := free_view_sheet(source, capture.id, album):
                views.append((label, uri))
            if found := mask_sheet(source, capture.id, album):
                masks.append((label, *found))
            if address := pages.get((label, capture.id)):
                avatars.append((label, address))
        hands = "two hands" if capture.hands == "both" else f"{capture.hands} hand"
        carried = ", ".join(perturbation(name).title for name in capture.perturbations)
        text = f"{hands}; {carried or 'no perturbation'}"
        if info:
            text = f"{info.action}: {text}; {info.frame_count} frames, {info.width}x{info.height}"
        strip = strip_plot(methods, info, HEADLINE)
        sections.append(
            CaptureSection(capture.id, text, strip, info is not None, frames, views, masks, avatars)
        )
    return sections


def _digests(result: Results) -> list[dict[str, str]]:
    return [
        {
            "method": f"{result.method.title}, seed {result.seed}",
            "capture": capture.id,
            "made_by": capture.made_by or "",
            "data": capture.digest,
            "split": capture.split_digest,
            "predictions": capture.predictions_digest,
        }
        for capture in result.captures
    ]
