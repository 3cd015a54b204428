"""The report: one self-contained HTML page about results, or one for each of their data."""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from markupsafe import Markup

from hwp_bench.analysis.bootstrap import bootstrap_mean
from hwp_bench.analysis.compare import (
    compare,
    differences_table,
    macro_by_seed,
    standings,
    standings_table,
)
from hwp_bench.analysis.cost import CostAnalysis, analyse_cost
from hwp_bench.analysis.pairing import MethodRuns, group_runs, refuse_unlike, scopes
from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import fitted, labelled, sheet
from hwp_bench.base.errors import BadResult, HwpError, UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.base.images import read_rgb
from hwp_bench.base.tables import Table
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.figures import (
    Bar,
    StripMethod,
    draw_bars,
    draw_pareto,
    inline_svg,
    series_classes,
    strip_plot,
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
from hwp_bench.report.tables import all_tables, free_view_table, same_data
from hwp_bench.results import Results
from hwp_bench.results.schema import add_isolation_note
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

if TYPE_CHECKING:
    from jinja2 import Environment

#: Name of the page.
PAGE = "index.html"


def style_sheet() -> Markup:
    """Return the style sheet of every page; it is the toolkit's own and is not escaped."""
    folder = resources.files("hwp_bench.report").joinpath("templates")
    return Markup(folder.joinpath("style.css").read_text("utf-8"))


def render_template(package: str, name: str, **values: Any) -> str:
    """Return a filled template; every value that is not `Markup` is escaped.

    Args:
        package: package with a folder `templates`.
        name: the template in it.
        values: what it shows.
    """
    return template_environment(package).get_template(name).render(values)


def template_environment(package: str) -> Environment:
    """Return what fills the templates of a package.

    Templates can call `series_classes` for the look of a method's curve.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
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


def render_report(report: ReportPage, title: str) -> str:
    """Return the page of a report."""
    return render_template(
        "hwp_bench.report",
        "report.html.j2",
        report=report,
        title=title,
        style=style_sheet(),
    )


def write_report(
    folder: Path,
    sources: Sequence[ResultsSource],
    captures: Sequence[str | os.PathLike[str]] = (),
    *,
    base: str | None = None,
    title: str | None = None,
    avatar_pages: bool = False,
) -> Path:
    """Write the report of some results; returns the page.

    Args:
        folder: where `index.html` goes.
        sources: the evaluations.
        captures: capture folders, for severities.
        base: method that shares of the gap are counted from.
        title: heading; None takes the methods' titles.
        avatar_pages: also copy the pages of avatars that lie in results folders, and lead to them.

    Raises:
        UsageError: the results cannot stand on one page.
        BadResult: what lies in the place of an avatar's page is none.
    """
    pages = copy_avatar_pages(folder, sources) if avatar_pages else {}
    report = gather_report(sources, captures, base=base, avatar_pages=pages)
    titles = dict.fromkeys(source.results.method.title for source in sources)
    heading = title or "HWP bench: " + ", ".join(titles)
    return atomic_write(folder / PAGE, render_report(report, heading))


def provenance(result: Results) -> dict[str, str]:
    """Say what the numbers of an evaluation depend on, in words, by heading."""
    environment = result.environment
    packages = environment.get("packages", {})
    devices = sorted({capture.device for capture in result.captures if capture.device})
    limits = [f"{value:g} {name}" for name, value in result.budget.items() if value]
    return {
        "Method": f"{result.method.title} ({result.method.name}), preset {result.method.preset}",
        "Settings": ", ".join(f"{k} = {v}" for k, v in result.method.settings.items()) or "none",
        "Suite, frames, seed": f"{result.suite}, {result.frames}, {result.seed}",
        "Budget": ", ".join(limits) or "none",
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


#: Name of a page within `captures/ID/` of a results folder.
AVATAR_PAGE = "avatar.html"
#: Largest page, bytes.
MAX_PAGE_BYTES = 32 << 20

#: Addresses by number of the result and id of the capture.
AvatarPages = dict[tuple[int, str], str]


def copy_avatar_pages(folder: Path, sources: Sequence[ResultsSource]) -> AvatarPages:
    """Copy pages of avatars next to a report.

    Args:
        folder: of the report; pages go into `avatars/`, under numbers.
        sources: the evaluations.

    Returns:
        Addresses within `folder`; results without pages have none.

    Raises:
        BadResult: a file in this place is too large, a link, or something else than a page.
    """
    found: AvatarPages = {}
    for index, source in enumerate(sources):
        for number, capture in enumerate(source.results.captures):
            path = source.place(capture.id, AVATAR_PAGE)
            if path is None or not path.exists():
                continue
            address = f"avatars/{index}-{number}.html"
            atomic_write(folder / address, _read(path))
            found[index, capture.id] = address
    return found


def _read(path: Path) -> str:
    if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_PAGE_BYTES:
        raise BadResult(f"must be a file of at most {MAX_PAGE_BYTES >> 20} MiB", where=path)
    try:
        text = path.read_text("utf-8")
    except UnicodeDecodeError:
        text = ""
    if not text.lstrip()[:15].lower().startswith("<!doctype html"):
        raise BadResult("is not an HTML page", where=path, remedy="Make it with `wildghand page`.")
    return text


#: Largest sum of the images in a page, bytes in base64.
MAX_BYTES = 8 * 1024 * 1024
#: Quality of the JPEGs: the sheets are for looking, the results keep the exact pixels.
QUALITY = 82
#: Larger edge of an image in the page, px.
EDGE = 1056
#: Weight masks shown of one capture, and their larger edge, px.
MASKS, MASK_EDGE = 6, 160


class Album:
    """Collects images until the budget is spent.

    Attributes:
        left: bytes that are left.
        left_out: how many images the budget did not allow.
    """

    def __init__(self, budget: int = MAX_BYTES) -> None:
        self.left = budget
        self.left_out = 0

    def take(self, pixels: np.ndarray) -> str | None:
        """Return an image as a data URI, or None where the budget does not allow it.

        Args:
            pixels: (H, W, 3) uint8.
        """
        if max(pixels.shape[:2]) > EDGE:
            pixels = fitted(pixels, EDGE)
        done, data = cv2.imencode(
            ".jpg", np.ascontiguousarray(pixels[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
        )
        uri = "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
        if not done or len(uri) > self.left:
            self.left_out += 1
            return None
        self.left -= len(uri)
        return uri

    def take_file(self, path: Path | None) -> str | None:
        """Return an image file as a data URI; None if it is missing or beyond the budget."""
        pixels = _read_picture(path)
        return None if pixels is None else self.take(pixels)


def frame_sheets(source: ResultsSource, capture: str, album: Album) -> str | None:
    """Return the sheet of worst, median and best frame that the evaluation drew."""
    return album.take_file(source.place(capture, "pictures", "comparison.png"))


def free_view_sheet(source: ResultsSource, capture: str, album: Album) -> str | None:
    """Return the sheet of views of the free-view clip that the evaluation drew."""
    return album.take_file(source.place(capture, "pictures", "free_view.png"))


def mask_sheet(source: ResultsSource, capture: str, album: Album) -> tuple[str, int] | None:
    """Return a sheet of a method's weight masks and how many there are, or None.

    At most `MASKS` are shown, spread evenly over the frames.
    """
    folder = source.place(capture, "diagnostics", "weights")
    if folder is None or not folder.is_dir():
        return None
    files = sorted(path for path in folder.iterdir() if re.fullmatch(r"\d{6}\.png", path.name))
    if not files:
        return None
    tiles = []
    for path in (files[index] for index in evenly(len(files), MASKS)):
        pixels = _read_picture(path)
        if pixels is not None:
            tiles.append(labelled(fitted(pixels, MASK_EDGE), f"frame {int(path.stem)}"))
    uri = album.take(sheet(tiles, columns=3)) if tiles else None
    return (uri, len(files)) if uri else None


def _read_picture(path: Path | None) -> np.ndarray | None:
    """Return (H, W, 3) uint8; None where the file is missing or not an image."""
    if path is None or not path.is_file():
        return None
    try:
        return read_rgb(path)
    except HwpError:
        return None


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
    tables: Sequence[Table]
    #: Score over seconds, or None without curves.
    pareto: Markup | None
    #: Tables of accuracy against time.
    cost_tables: Sequence[Table]
    #: Bars by perturbation, or None where no capture has one.
    bars: Markup | None
    #: Tables of differences with intervals.
    differences: Sequence[Table]
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
        tables=[add_isolation_note(table, results) for table in shown if len(table.columns) > 1],
        pareto=_pareto(cost, order) if cost else None,
        cost_tables=[add_isolation_note(table, results) for table in cost.tables.values()]
        if cost
        else [],
        bars=_bars(runs),
        differences=[add_isolation_note(table, results) for table in _differences(runs)],
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


def write_reports(
    folder: Path,
    sources: Sequence[ResultsSource],
    captures: Sequence[str | os.PathLike[str]] = (),
    *,
    base: str | None = None,
    title: str | None = None,
    avatar_pages: bool = False,
) -> list[Path]:
    """Write the report of some results, or one report for each of the data that they are on.

    Args:
        folder: where `index.html` goes; with results on several data it leads to `A/index.html`,
            `B/index.html`, and so on.
        sources: the evaluations.
        captures: capture folders, for severities.
        base: method that shares of the gap are counted from; data without it have no shares.
        title: heading; None takes the methods' titles.
        avatar_pages: as of `write_report`.

    Returns:
        The pages, the first one to open first.

    Raises:
        UsageError: there are no results, or no group has the base.
    """
    groups = data_groups(sources, oracles=True)
    if len(groups) < 2:
        only = write_report(
            folder, sources, captures, base=base, title=title, avatar_pages=avatar_pages
        )
        return [only]
    names = [{source.results.method.name for source in group.sources} for group in groups]
    if base is not None and not any(base in known for known in names):
        raise UsageError(f"no result is of {base!r}", field="--base")
    pages, rows = [], []
    for group, known in zip(groups, names, strict=True):
        shown = base if base in known else None
        page = write_report(
            folder / group.label,
            group.sources,
            captures,
            base=shown,
            title=title,
            avatar_pages=avatar_pages,
        )
        pages.append(page)
        perturbed = [s.results for s in group.sources if s.results.frames == "perturbed"]
        rows.append(
            {
                "address": f"{group.label}/{PAGE}",
                "label": group.label,
                "text": group.text,
                "methods": ", ".join(dict.fromkeys(s.results.method.title for s in group.sources)),
                "verdict": winner_note(perturbed) or "",
            }
        )
    text = render_template(
        "hwp_bench.report",
        "mixed.html.j2",
        title=title or "HWP bench: results on different data",
        style=style_sheet(),
        rows=rows,
    )
    return [atomic_write(folder / PAGE, text), *pages]
