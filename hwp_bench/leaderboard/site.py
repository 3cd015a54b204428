"""The leaderboard's site: one page of measured and published rows, and a report for each row."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from markupsafe import Markup

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_folder, canonical_json
from hwp_bench.leaderboard.board_rows import BoardRow, MethodRow, method_rows
from hwp_bench.leaderboard.curve_plot import curve_plot
from hwp_bench.leaderboard.entries import Entry, digest
from hwp_bench.leaderboard.gallery import write_gallery
from hwp_bench.leaderboard.lead import reference_lead
from hwp_bench.leaderboard.method_pages import MethodPage, method_pages, write_method_pages
from hwp_bench.leaderboard.page_row import (
    METRICS,
    SCOPES,
    Row,
    budget_text,
    make_row,
    severities_of,
)
from hwp_bench.leaderboard.records import BADGES, LEVEL_TEXTS
from hwp_bench.leaderboard.rules import SUITES, check_entries, tables_of
from hwp_bench.leaderboard.standings import rank_interval, ranks_of
from hwp_bench.metrics import HWP_V1
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.page.render import render_template, style_sheet, write_report
from hwp_bench.report.sources import ResultsSource, open_captures_of
from hwp_bench.results import Results
from hwp_bench.results.published import NOTE, read_published

#: Title of the site.
TITLE = "HWP bench leaderboard"


def build_site(
    folder: Path,
    entries: Sequence[Entry],
    results_folders: Sequence[ResultsSource] = (),
    *,
    avatar_pages: bool = False,
) -> Path:
    """Write the site into a folder that it replaces; returns its first page.

    Args:
        folder: where to.
        entries: the measured rows.
        results_folders: results with their folders; entries of the same results get images.
        avatar_pages: also copy the pages of avatars that lie in these folders, and lead to them.

    Raises:
        UsageError: entries do not fit together; the folder holds something else than a site.
    """
    check_entries(entries)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "board.js").is_file():
        raise UsageError("holds something else than a leaderboard", where=folder, field="-o")
    folders = {digest(source.results): source.folder for source in results_folders}
    captures = open_captures_of([source.results for source in results_folders])
    with atomic_folder(folder, overwrite=True) as temporary:
        rows = shown_rows(entries)
        shown = [
            (entry, ResultsSource(entry.results, folders[digest(entry.results)]))
            for entry in _first_seeds([row for row, _ in rows], folders)
        ]
        titles = _titles([entry for entry, _ in shown])
        scenes = write_gallery(temporary, shown, captures, titles)
        pages = method_pages(rows)
        page = board_page(rows, pictures=bool(scenes), pages=_addresses(pages))
        (temporary / "index.html").write_text(page, encoding="utf-8")
        (temporary / "board.js").write_text(script(), encoding="utf-8")
        if scenes:
            data = f"var GALLERY = {canonical_json(scenes)};\n"
            (temporary / "gallery.js").write_text(data, encoding="utf-8")
            (temporary / "viewer.js").write_text(script("viewer.js"), encoding="utf-8")
        for entry in entries:
            source = ResultsSource(entry.results, folders.get(digest(entry.results)))
            report = temporary / "reports" / entry.name
            write_report(report, [source], avatar_pages=avatar_pages)
        write_method_pages(temporary, pages, scenes)
    return folder / "index.html"


def _first_seeds(rows: Sequence[BoardRow], folders: Collection[str]) -> list[Entry]:
    """Of each row the entry of the lowest seed whose results lie in one of some folders."""
    found = ([one for one in row.entries if digest(one.results) in folders] for row in rows)
    return [entries[0] for entries in found if entries]


def _titles(entries: Sequence[Entry]) -> dict[str, str]:
    """How entries are called in lists: by method, with what tells two of one title apart."""
    names: dict[str, str] = {}
    for suite in {entry.results.suite for entry in entries}:
        rows = [entry for entry in entries if entry.results.suite == suite]
        for parts in (_title, _title_budget, _title_budget_digest):
            texts = [parts(entry.results) for entry in rows]
            names |= {
                entry.name: text
                for entry, text in zip(rows, texts, strict=True)
                if entry.name not in names and texts.count(text) == 1
            }
        names |= {entry.name: entry.name for entry in rows if entry.name not in names}
    return names


def _title(results: Results) -> str:
    return results.method.title


def _title_budget(results: Results) -> str:
    return f"{_title(results)} ({budget_text(results.budget)})"


def _title_budget_digest(results: Results) -> str:
    return f"{_title(results)} ({budget_text(results.budget)}, {results.method.digest[:8]})"


def shown_rows(entries: Sequence[Entry]) -> list[tuple[BoardRow, Row]]:
    """Return the rows of this version's protocol with what the page shows of them, best first."""
    found = [
        (method.row, make_row(method.row, method.label, method.older))
        for (_, protocol), rows in tables_of(entries).items()
        if protocol == HWP_V1.name
        for method in method_rows(rows)
    ]
    return sorted(
        found,
        key=lambda pair: (
            SUITES.index(pair[1].suite),
            not pair[0].whole,
            -(pair[1].scores["macro"]["psnr"] or 0.0),
            pair[1].name,
        ),
    )


def _addresses(pages: Sequence[MethodPage]) -> dict[str, str]:
    """The page of the method of each row, by the row's name."""
    return {shown.name: page.path for page in pages for _, shown in page.rows}


def board_page(
    found: Sequence[tuple[BoardRow, Row]], *, pictures: bool, pages: Mapping[str, str]
) -> str:
    """Return the page of the board.

    Args:
        found: what `shown_rows` returned.
        pictures: whether the viewer's pictures lie next to the page.
        pages: addresses of the methods' pages by the row's name; rows without one lead to a report.
    """
    rows = [shown for _, shown in found]
    suites = list(dict.fromkeys(row.suite for row in rows))
    ranks: dict[str, tuple[int, str]] = {}
    leads, verdicts = [], {}
    plots = {}
    for suite in suites:
        table = [row for row, shown in found if shown.suite == suite]
        named = [MethodRow(row, shown.title) for row, shown in found if shown.suite == suite]
        placed, verdicts[suite] = ranks_of(named)
        ranks |= {name: (rank.rank, rank_interval(rank)) for name, rank in placed.items()}
        leads.append(reference_lead(table))
        plots[suite] = curve_plot(table)
    return render_template(
        "hwp_bench.leaderboard",
        "board.html.j2",
        title=TITLE,
        style=style_sheet(),
        rows=rows,
        ranks=ranks,
        leads=[text for text in leads if text],
        verdicts={suite: text for suite, text in verdicts.items() if text},
        plots={suite: plot for suite, plot in plots.items() if plot is not None},
        pages=pages,
        scopes=SCOPES,
        severities=severities_of(rows),
        metrics=[metric_facts(name) for name in METRICS],
        suites=suites,
        budgets=list(dict.fromkeys(row.budget for row in rows)),
        published=_published(),
        note=NOTE,
        scores_json=_scores_json,
        pictures=pictures,
        levels=LEVEL_TEXTS,
        badges=BADGES,
    )


def _scores_json(row: Row, metric: str) -> str:
    """Return the scores of a row in every scope that it has, for the page's script."""
    scores = {scope: values[metric] for scope, values in row.scores.items()}
    return canonical_json({scope: score for scope, score in scores.items() if score is not None})


def _published() -> list[dict[str, Any]]:
    """Return the published rows that compare methods on the paper's captures."""
    return [
        {
            "method": item.method,
            # The paper's table by perturbation is only of interacting hands.
            "scope": ("Interacting hands: " if table.number == 5 else "") + SCOPES[item.scope],
            "table": table.number,
            "scores": item.scores,
        }
        for table in read_published().tables
        if table.number in (3, 5)
        for item in table.measurements
        if item.scope in SCOPES
    ]


def script(name: str = "board.js") -> Markup:
    """Return a script of the page."""
    folder = resources.files("hwp_bench.leaderboard").joinpath("templates")
    return Markup(folder.joinpath(name).read_text("utf-8"))
