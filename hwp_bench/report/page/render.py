"""Writes a gathered report as one self-contained HTML file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from markupsafe import Markup

from hwp_bench.base.files import atomic_write
from hwp_bench.report.avatar_pages import copy_avatar_pages
from hwp_bench.report.figures import series_classes
from hwp_bench.report.page.content import ReportPage, gather_report
from hwp_bench.report.sources import ResultsSource

#: Name of the page.
PAGE = "index.html"


def style_sheet() -> Markup:
    """Return the style sheet of every page; it is the toolkit's own and is not escaped."""
    folder = resources.files("hwp_bench.report.page").joinpath("templates")
    return Markup(folder.joinpath("style.css").read_text("utf-8"))


def render_template(package: str, name: str, **values: Any) -> str:
    """Return a filled template; every value that is not `Markup` is escaped.

    Templates can call `series_classes` for the look of a method's curve.

    Args:
        package: package with a folder `templates`.
        name: the template in it.
        values: what it shows.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name).render(series_classes=series_classes, **values)


def render_report(report: ReportPage, title: str) -> str:
    """Return the page of a report."""
    return render_template(
        "hwp_bench.report.page",
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
