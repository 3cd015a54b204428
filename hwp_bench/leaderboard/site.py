"""The leaderboard's site: one page of measured and published rows, and a report for each row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from markupsafe import Markup

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_folder, canonical_json
from hwp_bench.leaderboard.board_rows import board_rows
from hwp_bench.leaderboard.entries import Entry, digest
from hwp_bench.leaderboard.gallery import write_gallery
from hwp_bench.leaderboard.records import BADGES, LEVEL_TEXTS, Submission
from hwp_bench.leaderboard.rules import SUITES, check_entries, current, history, tables_of
from hwp_bench.leaderboard.standings import rank_interval, ranks_of
from hwp_bench.metrics import HWP_V1
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.metrics.aggregate import aggregate
from hwp_bench.report.page.render import render_template, style_sheet, write_report
from hwp_bench.report.sources import ResultsSource, open_captures_of
from hwp_bench.results.published import NOTE, read_published
from hwp_bench.results.schema import score_rows
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: Metrics of the board.
METRICS = ("psnr", "ssim", "oriented_distance")
#: Scopes that can be chosen, with their headings.
SCOPES = {
    "macro": "All perturbations (macro mean)",
    "single": "Single hands",
    "interacting": "Interacting hands",
    **{name: perturbation(name).heading for name in PERTURBATIONS},
}
#: Title of the site.
TITLE = "HWP bench leaderboard"


@dataclass(frozen=True)
class Row:
    """One measured row."""

    #: Name of the entry.
    name: str
    #: Title of the method.
    title: str
    #: Its suite.
    suite: str
    #: Its budget in words.
    budget: str
    #: Device that the method says it ran on.
    device: str
    #: Seed of everything random.
    seed: int
    #: Day of the evaluation, ISO 8601.
    date: str
    #: Scores by scope and metric; None where the suite has no such capture.
    scores: Mapping[str, Mapping[str, float | None]]
    #: Mean seconds of a fit.
    fit: float | None
    #: Frames that failed.
    failed: int
    #: Name of the protocol of the scores; rows of two protocols are never in one table.
    protocol: str
    #: How far it was checked, one of `records.LEVELS`.
    level: str
    #: Its reproducibility badge, one of `records.BADGES`.
    badge: str
    #: What the submitter added: links, digests of avatars, what is revised and why.
    submission: Submission
    #: 1 for a first entry, one more for each correction.
    revision: int


def make_row(entry: Entry, entries: Sequence[Entry] = ()) -> Row:
    """Return the row of an entry.

    Args:
        entry: the entry.
        entries: those among which the ones that it revises are found.
    """
    results = entry.results
    mean = aggregate(score_rows(results))
    found: dict[str, Mapping[str, float]] = {
        "macro": mean.overall.macro,
        "single": mean.single.capture_mean if mean.single else {},
        "interacting": mean.interacting.capture_mean if mean.interacting else {},
        **mean.overall.perturbations,
    }
    fits = [c.fit_seconds for c in results.captures if c.fit_seconds is not None]
    return Row(
        name=entry.name,
        title=results.method.title,
        suite=results.suite,
        budget=budget_text(results.budget),
        device=", ".join(sorted({c.device for c in results.captures if c.device})) or "not said",
        seed=results.seed,
        date=results.started[:10],
        scores={
            scope: {name: found.get(scope, {}).get(name) for name in METRICS} for scope in SCOPES
        },
        fit=sum(fits) / len(fits) if fits else None,
        failed=sum(capture.failed_frames for capture in results.captures),
        protocol=entry.protocol,
        level=entry.level,
        badge=entry.badge,
        submission=entry.submission,
        revision=1 + len(history(entry, entries)),
    )


def budget_text(budget: Mapping[str, Any]) -> str:
    """Return a budget in words: `60 s`, `500 steps`, `60 s, 500 steps` or `no limit`."""
    units = {"seconds": "s", "steps": "steps"}
    parts = [f"{budget[name]:g} {unit}" for name, unit in units.items() if budget.get(name)]
    return ", ".join(parts) or "no limit"


def build_site(
    folder: Path, entries: Sequence[Entry], results_folders: Sequence[ResultsSource] = ()
) -> Path:
    """Write the site into a folder that it replaces; returns its first page.

    Args:
        folder: where to.
        entries: the measured rows.
        results_folders: results with their folders; entries of the same results get images.

    Raises:
        UsageError: entries do not fit together; the folder holds something else than a site.
    """
    check_entries(entries)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "board.js").is_file():
        raise UsageError("holds something else than a leaderboard", where=folder, field="-o")
    folders = {digest(source.results): source.folder for source in results_folders}
    captures = open_captures_of([source.results for source in results_folders])
    with atomic_folder(folder, overwrite=True) as temporary:
        shown = [
            (entry, ResultsSource(entry.results, folders[digest(entry.results)]))
            for entry in current(entries)
            if digest(entry.results) in folders
        ]
        scenes = write_gallery(temporary, shown, captures, _titles(entries))
        page = board_page(entries, pictures=bool(scenes))
        (temporary / "index.html").write_text(page, encoding="utf-8")
        (temporary / "board.js").write_text(script(), encoding="utf-8")
        if scenes:
            data = f"var GALLERY = {canonical_json(scenes)};\n"
            (temporary / "gallery.js").write_text(data, encoding="utf-8")
            (temporary / "viewer.js").write_text(script("viewer.js"), encoding="utf-8")
        for entry in entries:
            source = ResultsSource(entry.results, folders.get(digest(entry.results)))
            write_report(temporary / "reports" / entry.name, [source])
    return folder / "index.html"


def _titles(entries: Sequence[Entry]) -> dict[str, str]:
    """How entries are called in lists: by method, with what tells two of one title apart."""
    kinds = [(entry.results.method.title, entry.results.suite) for entry in entries]
    return {
        entry.name: f"{kind[0]} ({budget_text(entry.results.budget)}, seed {entry.results.seed})"
        if kinds.count(kind) > 1
        else kind[0]
        for entry, kind in zip(entries, kinds, strict=True)
    }


def board_page(entries: Sequence[Entry], *, pictures: bool = False) -> str:
    """Return the page of the board.

    Args:
        entries: the measured rows.
        pictures: whether the viewer's pictures lie next to the page.
    """
    rows = sorted(
        (make_row(entry, entries) for entry in current(entries) if entry.protocol == HWP_V1.name),
        key=lambda row: (SUITES.index(row.suite), -(row.scores["macro"]["psnr"] or 0.0), row.name),
    )
    ranks, verdicts = {}, {}
    for (suite, protocol), found in tables_of(current(entries)).items():
        if protocol == HWP_V1.name:
            grouped = board_rows(found)
            placed, verdicts[suite] = ranks_of(grouped)
            # Every seed of a method shows the rank of the method.
            ranks.update(
                {
                    entry.name: (rank.rank, rank_interval(rank))
                    for row in grouped
                    if (rank := placed.get(row.entries[0].name))
                    for entry in row.entries
                }
            )
    return render_template(
        "hwp_bench.leaderboard",
        "board.html.j2",
        title=TITLE,
        style=style_sheet(),
        rows=rows,
        ranks=ranks,
        verdicts={suite: text for suite, text in verdicts.items() if text},
        scopes=SCOPES,
        metrics=[metric_facts(name) for name in METRICS],
        suites=[suite for suite in SUITES if any(row.suite == suite for row in rows)],
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
