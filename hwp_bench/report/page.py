"""The report: one self-contained HTML page about results, or one for each of their data."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from markupsafe import Markup

from hwp_bench.analysis.compare import (
    Ranking,
    compare,
    differences_table,
    rank_methods,
    standings,
    standings_table,
    verdict,
)
from hwp_bench.analysis.cost import PLAIN, CostAnalysis, analyse_cost
from hwp_bench.analysis.pairing import MethodRuns, group_runs, refuse_unlike
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write, refuse_existing_file
from hwp_bench.base.tables import Table
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.figures import (
    StripMethod,
    bands_text,
    bars_by_perturbation,
    draw_pareto,
    inline_svg,
    series_classes,
    strip_plot,
)
from hwp_bench.report.pictures import (
    MAX_BYTES,
    Album,
    AvatarPages,
    copy_avatar_pages,
    mask_sheet,
    read_picture,
)
from hwp_bench.report.sources import (
    ResultsSource,
    data_groups,
    find_captures,
    sound_temporal_weights,
)
from hwp_bench.report.study_tables import (
    bias_table,
    rank_table,
    robustness_table,
    seeds_table,
    severity_table,
    winner_note,
)
from hwp_bench.report.tables import all_tables, free_view_table, over_seeds, same_data
from hwp_bench.results import Results
from hwp_bench.results.schema import add_isolation_note, budget_text
from hwp_bench.taxonomy import perturbation

if TYPE_CHECKING:
    from jinja2 import Environment

T = TypeVar("T")

#: Name of the page.
PAGE = "index.html"
# In the head of every page that is written here, which marks it as a report.
_GENERATOR = b'<meta name="generator" content="hwp-bench report">'


def style_sheet() -> Markup:
    """Return the style sheet of every page; it is the toolkit's own and is not escaped."""
    folder = resources.files("hwp_bench.report").joinpath("templates")
    return Markup(folder.joinpath("style.css").read_text("utf-8"))


def render_template(package: str, name: str, **values: Any) -> str:
    """Return a filled template; every value that is not `Markup` is escaped."""
    return template_environment(package).get_template(name).render(values)


def template_environment(package: str) -> Environment:
    """Return what fills the templates of a package.

    Templates can call `series_classes` for the look of a method's curve.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader, strict = PackageLoader(package), StrictUndefined
    environment = Environment(
        loader=loader, autoescape=True, undefined=strict, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["unbroken"] = _unbroken
    environment.globals.update({"series_classes": series_classes, "column_groups": _column_groups})
    return environment


def _unbroken(heading: str) -> str:
    """Return a heading that keeps its arrow and unit on the line of its last word."""
    return heading.replace(" ↑", "\u00a0↑").replace(" ↓", "\u00a0↓").replace(" [", "\u00a0[")


def _column_groups(table: Table) -> list[tuple[str, int]]:
    """Return the texts over groups of columns, and how many columns each spans."""
    return [(group, len(list(own))) for group, own in groupby(c.group for c in table.columns)]


def write_report(
    folder: Path,
    sources: Sequence[ResultsSource],
    captures: Sequence[str | os.PathLike[str]] = (),
    *,
    base: str | None = None,
    title: str | None = None,
    avatar_pages: bool = False,
) -> Path:
    """Write the report of some results; returns the page."""
    pages = copy_avatar_pages(folder, sources) if avatar_pages else {}
    report = gather_report(sources, captures, base=base, avatar_pages=pages)
    titles = dict.fromkeys(source.results.method.title for source in sources)
    heading = title or "HWP bench: " + ", ".join(titles)
    return _write(folder, "report.html.j2", title=heading, report=report)


def _write(folder: Path, template: str, **values: Any) -> Path:
    text = render_template("hwp_bench.report", template, style=style_sheet(), **values)
    return atomic_write(folder / PAGE, text)


def _is_report(page: Path) -> bool:
    """Whether a file is a page that `_write` has written."""
    if not page.is_file():
        return False
    with page.open("rb") as file:
        return _GENERATOR in file.read(1000)


def provenance(result: Results) -> dict[str, str]:
    """Say what the numbers of an evaluation depend on, in words, by heading."""
    environment = result.environment
    packages = environment.get("packages", {})
    devices = sorted({capture.device for capture in result.captures if capture.device})
    return {
        "Method": f"{result.method.title} ({result.method.name}), preset {result.method.preset}",
        "Settings": ", ".join(f"{k} = {v}" for k, v in result.method.settings.items()) or "none",
        "Training data": result.method.training.text,
        "Suite, frames, seed": f"{result.suite}, {result.frames}, {result.seed}",
        "Budget": budget_text(result.budget),
        "Started": result.started,
        "Device": ", ".join(devices) or "not said",
        "System": f"{environment.get('system', '?')}, {environment.get('processor', '?')}, "
        f"{environment.get('cores', '?')} cores, Python {environment.get('python', '?')}",
        "Packages": ", ".join(f"{k} {v}" for k, v in packages.items())
        if isinstance(packages, dict)
        else "?",
        "Toolkit": result.toolkit,
        "Method digest": result.method.digest,
    }


#: The metric of the plots and of the summary sentence.
HEADLINE = "psnr"


def gather_report(
    sources: Sequence[ResultsSource],
    capture_folders: Sequence[str | os.PathLike[str]] = (),
    *,
    base: str | None = None,
    image_bytes: int = MAX_BYTES,
    avatar_pages: AvatarPages | None = None,
) -> dict[str, Any]:
    """Return what the template shows, by name."""
    if not sources:
        raise UsageError("results are needed", field="RESULTS")
    results = [source.results for source in sources]
    same_data(results)
    chosen = [s for s in sources if s.results.frames == "perturbed"] or list(sources)
    measured = [source.results for source in chosen]
    runs = group_runs(measured)
    refuse_unlike(runs)
    infos = find_captures(results, capture_folders)
    album = Album(image_bytes)
    plain = next((PLAIN for run in runs if run.first.method.name == PLAIN), None)
    cost = _optional(lambda: analyse_cost(runs, HEADLINE))
    ranking = _optional(lambda: rank_methods(runs, HEADLINE))
    several = any(len(run.seeds) > 1 for run in runs)
    tables = {name: over_seeds(one, measured) for name, one in all_tables(measured).items()}
    shown = [
        tables["overall"],
        _optional(lambda: rank_table(runs, ranking)) if len(runs) > 1 else None,
        tables["perturbations"],
        tables["captures"],
        _optional(lambda: free_view_table(measured)),
        replace(tables["paper"], caption="Protocol paper-wildghand"),
        _optional(lambda: robustness_table(sources, base or plain)),
        _optional(lambda: over_seeds(severity_table(chosen, infos), measured)),
        _optional(lambda: bias_table(chosen, infos)),
        _optional(lambda: seeds_table(chosen)) if several else None,
    ]

    def noted(found: Iterable[Table | None]) -> list[Table]:
        return [add_isolation_note(one, results) for one in found if one and len(one.columns) > 1]

    return {
        "summary": summary_sentence(runs, ranking),
        "methods": [run.label for run in runs],
        "tables": noted(shown),
        "pareto": _pareto(cost, runs) if cost else None,
        "bands": bands_text(cost.curves) if cost else "",
        "cost_tables": noted(cost.tables.values() if cost else ()),
        "bars": bars_by_perturbation(runs, HEADLINE),
        "differences": noted(_optional(lambda: _differences(runs)) or ()),
        "captures": _captures(chosen, runs, infos, album, sources, avatar_pages or {}),
        "provenance": [provenance(result) for result in results],
        "digests": [
            {
                "method": f"{result.method.title}, seed {result.seed}",
                "capture": capture.id,
                "made_by": capture.made_by or "",
                "data": capture.digest,
                "split": capture.split_digest,
                "predictions": capture.predictions_digest,
            }
            for result in results
            for capture in result.captures
        ],
        "left_out": album.left_out,
    }


def summary_sentence(runs: Sequence[MethodRuns], ranking: Ranking | None) -> str:
    """Return what the results say, in words; they have no ranking without common seeds."""
    first = runs[0].first
    frames = sum(len(capture.frames) for capture in first.captures)
    where = f"On {len(first.captures)} captures ({first.suite}, {frames} test frames)"
    failed = sum(c.failed_frames for run in runs for r in run.seeds.values() for c in r.captures)
    tail = f" {failed} frames failed and count with their penalties." if failed else ""
    told = "some methods have no seed in common, so none is ranked."
    return f"{where}: {verdict(ranking) if ranking else told}{tail}"


def _optional(make: Callable[[], T]) -> T | None:
    """Return what is made of results that hold enough for it, else None."""
    try:
        return make()
    except UsageError:
        return None


def _pareto(cost: CostAnalysis, runs: Sequence[MethodRuns]) -> Markup:
    order = {run.label: index for index, run in enumerate(runs)}
    figure = draw_pareto(cost.curves, cost.front, HEADLINE, order)
    return inline_svg(figure, f"{metric_facts(HEADLINE).label} over seconds of fitting")


def _differences(runs: Sequence[MethodRuns]) -> list[Table]:
    if len(runs) < 2:
        return []
    found = compare(runs, HEADLINE)
    return [
        standings_table(HEADLINE, standings(runs, HEADLINE, found)),
        differences_table(HEADLINE, found),
    ]


def _captures(
    chosen: Sequence[ResultsSource],
    runs: Sequence[MethodRuns],
    infos: Mapping[str, CaptureInfo],
    album: Album,
    sources: Sequence[ResultsSource],
    pages: AvatarPages,
) -> list[dict[str, Any]]:
    """Return the sections of the captures: facts, strip, and pictures by method."""
    places = {id(source.results): place for place, source in enumerate(sources)}
    shown = [
        (run.label, source) for run in runs for source in chosen if source.results is run.first
    ]
    sections = []
    for capture in runs[0].first.captures:
        info = infos.get(capture.digest)
        methods: list[StripMethod] = []
        found: dict[str, list[tuple[Any, ...]]] = {
            name: [] for name in ("frames", "views", "masks", "avatars")
        }
        for label, source in shown:
            own = next(c for c in source.results.captures if c.id == capture.id)
            weights = sound_temporal_weights(source, capture.id)
            methods.append(StripMethod(len(methods), label, own, weights))
            for name, file in (("frames", "comparison.png"), ("views", "free_view.png")):
                picture = read_picture(source.place(capture.id, "pictures", file))
                if uri := album.take(picture):
                    found[name].append((label, uri))
            if masks := mask_sheet(source, capture.id, album):
                found["masks"].append((label, *masks))
            if address := pages.get((places[id(source.results)], capture.id)):
                found["avatars"].append((label, address))
        hands = "two hands" if capture.hands == "both" else f"{capture.hands} hand"
        carried = ", ".join(perturbation(name).title for name in capture.perturbations)
        text = f"{hands}; {carried or 'no perturbation'}"
        if info:
            text = f"{info.action}: {text}; {info.frame_count} frames, {info.width}x{info.height}"
        strip = strip_plot(methods, info, HEADLINE)
        known = info is not None
        sections.append(
            {"id": capture.id, "facts": text, "strip": strip, "severities": known, **found}
        )
    return sections


def write_reports(
    folder: Path,
    sources: Sequence[ResultsSource],
    captures: Sequence[str | os.PathLike[str]] = (),
    *,
    base: str | None = None,
    title: str | None = None,
    avatar_pages: bool = False,
    overwrite: bool = False,
) -> list[Path]:
    """Write the report of some results, or one report for each of the data that they are on.

    Reports are replaced; other pages only with `overwrite`.
    """
    groups = data_groups(sources, oracles=True)
    for place in (folder, *(folder / group.label for group in groups)):
        if not _is_report(place / PAGE):
            refuse_existing_file(place / PAGE, overwrite=overwrite, field="--out")

    def write(place: Path, own: Sequence[ResultsSource], base: str | None) -> Path:
        return write_report(place, own, captures, base=base, title=title, avatar_pages=avatar_pages)

    names = [{source.results.method.name for source in group.sources} for group in groups]
    if base is not None and not any(base in known for known in names):
        raise UsageError(f"no result is of {base!r}", field="--baseline")
    if len(groups) < 2:
        return [write(folder, sources, base)]
    pages, rows = [], []
    for group, known in zip(groups, names, strict=True):
        pages.append(write(folder / group.label, group.sources, base if base in known else None))
        results = [source.results for source in group.sources]
        rows.append(
            {
                "address": f"{group.label}/{PAGE}",
                "label": group.label,
                "text": group.text,
                "methods": ", ".join(dict.fromkeys(result.method.title for result in results)),
                "verdict": winner_note([r for r in results if r.frames == "perturbed"]) or "",
            }
        )
    heading = title or "HWP bench: results on different data"
    return [_write(folder, "mixed.html.j2", title=heading, rows=rows), *pages]
