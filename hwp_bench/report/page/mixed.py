"""Reports of results on different data: a page for each, and one that leads to them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.report.data_groups import data_groups
from hwp_bench.report.page.render import PAGE, render_template, style_sheet, write_report
from hwp_bench.report.ranking_tables import winner_note
from hwp_bench.report.sources import ResultsSource


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
        "hwp_bench.report.page",
        "mixed.html.j2",
        title=title or "HWP bench: results on different data",
        style=style_sheet(),
        rows=rows,
    )
    return [atomic_write(folder / PAGE, text), *pages]
