"""The leaderboard's site: the board, pictures, a page for each method and a report for each row."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt
from markupsafe import Markup

from hwp_bench.analysis.cost import analyse_cost
from hwp_bench.analysis.pairing import group_runs
from hwp_bench.base.console import notice
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_folder, canonical_json
from hwp_bench.leaderboard.board import (
    SCOPES,
    BoardRow,
    method_rows,
    ranks_of,
    severities_of,
)
from hwp_bench.leaderboard.data_card import data_card
from hwp_bench.leaderboard.entries import BADGES, Entry, digest
from hwp_bench.leaderboard.gallery import write_extremes, write_gallery
from hwp_bench.leaderboard.rules import HEADLINE, SUITES, check_entries, source_of, tables_of
from hwp_bench.methods.manifest import shipped_methods
from hwp_bench.metrics import HWP_V1
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.figures import bands_text, draw_pareto, inline_svg
from hwp_bench.report.page import provenance, render_template, style_sheet, write_report
from hwp_bench.report.sources import ResultsSource, open_captures_of
from hwp_bench.report.study_tables import METRIC
from hwp_bench.results.published import NOTE, read_published
from hwp_bench.results.schema import TRAINING_KINDS, budget_text
from hwp_bench.taxonomy import SUITE_TEXTS

#: Longest text of a method that is shown, characters.
_LONGEST = 60_000


@dataclass(frozen=True)
class MethodPage:
    """One page."""

    #: Its address within the site.
    path: str
    #: Name and title of the method.
    name: str
    title: str
    #: The method's rows.
    rows: Sequence[BoardRow]


def method_pages(rows: Sequence[BoardRow]) -> list[MethodPage]:
    """Return a page for each method: rows of one name and of one who stands for it."""
    found: dict[tuple[str, str], list[BoardRow]] = {}
    for row in rows:
        _, by = source_of(row.entries[0])
        found.setdefault((row.first.method.name, by), []).append(row)
    # Names come from outside: the number keeps two of them apart, whatever is left of them.
    pages = []
    for number, ((name, _), own) in enumerate(sorted(found.items(), key=lambda x: x[0])):
        slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:60] or "method"
        pages.append(MethodPage(f"methods/{number}-{slug}.html", name, own[0].title, own))
    return pages


def write_method_pages(
    folder: Path,
    pages: Sequence[MethodPage],
    extremes: Mapping[str, Sequence[Mapping[str, Any]]] | None = None,
) -> None:
    """Write the pages into a site; `extremes` are those of `write_extremes`."""
    (folder / "methods").mkdir()
    shipped = {manifest.name: manifest for manifest in shipped_methods()}
    for page in pages:
        manifest = shipped.get(page.name)
        readme = manifest.root / "README.md" if manifest else None
        html = render_template(
            "hwp_bench.leaderboard",
            "method.html.j2",
            style=style_sheet(),
            page=page,
            description=manifest.description if manifest else "",
            text=_formatted(readme.read_text("utf-8")) if readme and readme.is_file() else "",
            metrics=[metric_facts(name) for name in HEADLINE],
            scopes=SCOPES,
            pictures=_pictures(page, extremes or {}),
            contested=[entry for row in page.rows for entry in _contested(row)],
            avatars=_avatars(folder, page),
            facts=[_made_with(row) for row in page.rows],
            budget_text=budget_text,
            why_older=BoardRow.why_older,
        )
        (folder / page.path).write_text(html, encoding="utf-8")


def _formatted(text: str) -> Markup:
    """Return Markdown as HTML, one level of headings deeper and without links and pictures.

    Only texts that ship with the toolkit come here; HTML within them is shown and not used.
    """
    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = reader.parse(text[:_LONGEST])
    for token in tokens:
        if token.tag in ("h1", "h2", "h3"):
            token.tag = f"h{int(token.tag[1]) + 2}"
        kept = [one for one in token.children or [] if one.type not in ("link_open", "link_close")]
        token.children = [one for one in kept if one.type != "image"]
    return Markup(reader.renderer.render(tokens, reader.options, {}))


def _pictures(
    page: MethodPage, extremes: Mapping[str, Sequence[Mapping[str, Any]]]
) -> dict[str, Sequence[Mapping[str, Any]]]:
    """By suite the best and worst frames of the first entry of the method that has pictures."""
    entries = [entry for row in page.rows for entry in row.entries if entry.name in extremes]
    return {entry.results.suite: extremes[entry.name] for entry in reversed(entries)}


def _contested(row: BoardRow) -> list[Entry]:
    """The entries of a row and its history that somebody contested, settled or not."""
    return [entry for entry in (*row.entries, *row.older) if entry.contests]


def _avatars(folder: Path, page: MethodPage) -> dict[str, str]:
    """Addresses of avatars by capture, of the first entry of each that has one."""
    found: dict[str, str] = {}
    for row in page.rows:
        for entry in row.entries:
            for number, capture in enumerate(entry.results.captures):
                address = f"reports/{entry.name}/avatars/0-{number}.html"
                if (folder / address).is_file():
                    found.setdefault(f"{capture.id} of {row.suite}", address)
    return found


def _made_with(row: BoardRow) -> dict[str, str]:
    """Say in words how the numbers of a row were made; empty where it is not known."""
    results, captures = row.first, row.captures
    told = [provenance(one) for one in row.runs]
    cpu = [capture.cpu_seconds for capture in captures if capture.cpu_seconds is not None]
    seeds = ", ".join(str(seed) for seed in row.seeds)
    return {name: _joined(one[name] for one in told) for name in told[0]} | {
        "Suite, frames, seed": f"{results.suite}, {results.frames}, {seeds}",
        "Digests of training data": _named(
            {name: " ".join(own)} for name, own in results.method.training.simulated.items()
        ),
        "Started": ", ".join(entry.results.started for entry in row.entries),
        "Protocol": ", ".join(results.protocols),
        "Seconds on one core": f"{sum(cpu) / len(cpu):.1f} a fit" if cpu else "",
        "Isolation": ", ".join(sorted({one.isolation for one in captures if one.isolation})),
        "Digest of the toolkit's code": _joined(
            str(one.environment.get("code", "")) for one in row.runs
        ),
        "Checked": row.level,
        "Badge": row.badge,
        "Submitted by": _joined(entry.submission.by for entry in row.entries),
        "Corrections": _joined(_correction(entry) for entry in row.entries),
        "Links": _named(entry.submission.links for entry in row.entries),
        "Avatars": _named(entry.submission.avatars for entry in row.entries),
        "Hands and masks made by": _joined(one.made_by or "" for one in captures),
        "Digests of the predictions": _joined(
            f"{one.id} {one.predictions_digest[:16]}" for one in captures
        ),
        "Digests of the entries": _joined(entry.digest for entry in row.entries),
    }


def _joined(texts: Iterable[str]) -> str:
    """Different texts that are not empty, in their order."""
    return ", ".join(dict.fromkeys(text for text in texts if text))


def _named(values: Iterable[Mapping[str, str]]) -> str:
    return _joined(f"{key}: {value}" for one in values for key, value in one.items())


def _correction(entry: Entry) -> str:
    submission = entry.submission
    return f"of {submission.revises}: {submission.reason}" if submission.revises else ""


#: Title of the site.
TITLE = "HWP bench leaderboard"


def build_site(
    folder: Path,
    entries: Sequence[Entry],
    results_folders: Sequence[ResultsSource] = (),
    *,
    avatar_pages: bool = False,
) -> Path:
    """Write the site into a folder that it replaces; returns its first page."""
    check_entries(entries)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "board.js").is_file():
        raise UsageError("holds something else than a leaderboard", where=folder, field="-o")
    given = [(digest(source.results), source.folder) for source in results_folders]
    folders = dict(given)
    known = {digest(entry.results) for entry in entries}
    for content, where in given:
        if content not in known:
            notice(f"left out: {where} is of no entry")
    captures = open_captures_of([source.results for source in results_folders])
    with atomic_folder(folder, overwrite=True) as temporary:
        rows = shown_rows(entries)
        shown = [
            (entry, ResultsSource(entry.results, folders[digest(entry.results)]))
            for entry in _first_seeds(rows, folders)
        ]
        titles = _titles([entry for entry, _ in shown])
        scenes = write_gallery(temporary, shown, captures, titles)
        extremes = write_extremes(temporary, shown, captures)
        pages = method_pages(rows)
        addresses = {row.name: page.path for page in pages for row in page.rows}
        files = {
            "index.html": board_page(rows, pictures=bool(scenes), pages=addresses),
            "board.js": script(),
        }
        if scenes:
            files["gallery.js"] = f"var GALLERY = {canonical_json(scenes)};\n"
            files["viewer.js"] = script("viewer.js")
        (temporary / "data").mkdir()
        for suite in dict.fromkeys(row.suite for row in rows):
            files[f"data/{suite}.json"] = json.dumps(data_card(suite), indent=1) + "\n"
        for name, text in files.items():
            (temporary / name).write_text(text, encoding="utf-8")
        for entry in entries:
            source = ResultsSource(entry.results, folders.get(digest(entry.results)))
            report = temporary / "reports" / entry.name
            write_report(report, [source], avatar_pages=avatar_pages)
        write_method_pages(temporary, pages, extremes)
    return folder / "index.html"


def _first_seeds(rows: Sequence[BoardRow], folders: Collection[str]) -> list[Entry]:
    """Of each row the entry of the lowest seed whose results lie in one of some folders."""
    found = ([one for one in row.entries if digest(one.results) in folders] for row in rows)
    return [entries[0] for entries in found if entries]


def _titles(entries: Sequence[Entry]) -> dict[str, str]:
    """Names of entries in lists: the method's title, and more where two share a title."""
    names: dict[str, str] = {}
    for suite in {entry.results.suite for entry in entries}:
        rows = [entry for entry in entries if entry.results.suite == suite]
        told = []
        for entry in rows:
            method, budget = entry.results.method, budget_text(entry.results.budget)
            whole = f"{method.title} ({budget}, {method.digest[:8]})"
            told.append((method.title, f"{method.title} ({budget})", whole, entry.name))
        for texts in zip(*told, strict=True):
            for entry, text in zip(rows, texts, strict=True):
                if texts.count(text) == 1:
                    names.setdefault(entry.name, text)
    return names


def shown_rows(entries: Sequence[Entry]) -> list[BoardRow]:
    """Return the rows of this version's protocol with what the page shows of them, best first."""

    def place(row: BoardRow) -> tuple[int, bool, float, str]:
        score = row.scopes["macro"]["psnr"] or 0.0
        return SUITES.index(row.suite), not row.whole, -score, row.name

    tables = tables_of(entries).items()
    own = [entries for (_, protocol), entries in tables if protocol == HWP_V1.name]
    return sorted((row for entries in own for row in method_rows(entries)), key=place)


def board_page(rows: Sequence[BoardRow], *, pictures: bool, pages: Mapping[str, str]) -> str:
    """Return the page of the board."""
    ranks: dict[str, tuple[int, str]] = {}
    suites = []
    for name in dict.fromkeys(row.suite for row in rows):
        table = [row for row in rows if row.suite == name]
        placed, verdict = ranks_of(table)
        ranks |= {key: (rank.rank, rank.interval) for key, rank in placed.items()}
        text = SUITE_TEXTS[name]
        suites.append(
            {
                "name": name,
                "text": text,
                "rows": table,
                "verdict": verdict,
                "plot": curve_plot(table),
            }
        )
    kinds = [kind for kind in TRAINING_KINDS if any(kind in row.training for row in rows)]
    return render_template(
        "hwp_bench.leaderboard",
        "board.html.j2",
        title=TITLE,
        style=style_sheet(),
        suites=suites,
        ranks=ranks,
        pages=pages,
        scopes=SCOPES,
        severities=severities_of(rows),
        metrics=[metric_facts(name) for name in HEADLINE],
        budgets=list(dict.fromkeys(row.budget for row in rows)),
        kinds={kind: TRAINING_KINDS[kind] for kind in kinds},
        published=_published(),
        note=NOTE,
        scores_json=_scores_json,
        pictures=pictures,
        badges={name: text for name, text in BADGES.items() if name in {row.badge for row in rows}},
    )


def curve_plot(rows: Sequence[BoardRow]) -> dict[str, Any] | None:
    """Draw the mean score of validation frames over the seconds of fitting, and the front.

    Returns:
        The plot (`figure`), the labels of the methods in the order of their colours (`methods`),
        of those on the Pareto front for some time (`front`), what the bands are (`bands`), and what
        the curves lack or mix (`notes`).
        None where no whole row left a curve, or where one submitted twice cannot be told apart.
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
    title = f"{metric_facts(METRIC).label} over seconds of fitting on {whole[0].first.suite}"
    figure = inline_svg(draw_pareto(cost.curves, cost.front, METRIC, order), title)
    leading = {part.label for part in cost.front}
    front = [label for label in order if label in leading]
    bands = bands_text(cost.curves)
    return {
        "figure": figure,
        "methods": list(order),
        "front": front,
        "bands": bands,
        "notes": cost.notes,
    }


def _scores_json(row: BoardRow, metric: str) -> str:
    """Return the scores of a row in every scope that it has, for the page's script."""
    scores = {scope: values[metric] for scope, values in row.scopes.items()}
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
