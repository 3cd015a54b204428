"""A page for each method of the board: what it is, its scores, what these were made with."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt
from markupsafe import Markup

from hwp_bench.leaderboard.board_rows import BoardRow
from hwp_bench.leaderboard.entries import Entry
from hwp_bench.leaderboard.page_row import METRICS, SCOPES, Row
from hwp_bench.leaderboard.rules import source_of
from hwp_bench.methods.manifest import shipped_methods
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.report.page.render import render_template, style_sheet
from hwp_bench.report.provenance import provenance

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
    #: The method's rows, each with what the board shows of it.
    rows: Sequence[tuple[BoardRow, Row]]


def method_pages(rows: Sequence[tuple[BoardRow, Row]]) -> list[MethodPage]:
    """Return a page for each method: rows of one name and of one who stands for it.

    Args:
        rows: rows of the board with what it shows of them.
    """
    found: dict[tuple[str, str], list[tuple[BoardRow, Row]]] = {}
    for row, shown in rows:
        method = row.first.method
        _, by = source_of(row.entries[0])
        found.setdefault((method.name, by), []).append((row, shown))
    # Names come from outside: the number keeps two of them apart, whatever is left of them.
    return [
        MethodPage(f"methods/{number}-{_slug(name)}.html", name, own[0][1].title, own)
        for number, ((name, _), own) in enumerate(sorted(found.items(), key=lambda x: x[0]))
    ]


def write_method_pages(
    folder: Path, pages: Sequence[MethodPage], scenes: Sequence[Mapping[str, Any]] = ()
) -> None:
    """Write the pages into a site.

    Args:
        folder: of the site; its reports are there already.
        pages: what `method_pages` returned.
        scenes: what `gallery.write_gallery` returned, for pictures.
    """
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
            metrics=[metric_facts(name) for name in METRICS],
            scopes=SCOPES,
            pictures=_pictures(page, scenes),
            avatars=_avatars(folder, page),
            facts=[_made_with(row) for row, _ in page.rows],
        )
        (folder / page.path).write_text(html, encoding="utf-8")


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:60] or "method"


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


def _pictures(page: MethodPage, scenes: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The first frame of each capture that the gallery shows of the method."""
    names = {entry.name for row, _ in page.rows for entry in row.entries}
    found: dict[str, dict[str, Any]] = {}
    for scene in scenes:
        for shot in scene["shots"]:
            if shot["entry"] in names and scene["capture"] not in found:
                found[scene["capture"]] = {**scene, "shot": shot}
    return list(found.values())


def _avatars(folder: Path, page: MethodPage) -> dict[str, str]:
    """Addresses of avatars by capture, of the first entry of each that has one."""
    found: dict[str, str] = {}
    for row, _ in page.rows:
        for entry in row.entries:
            for number, capture in enumerate(entry.results.captures):
                address = f"reports/{entry.name}/avatars/0-{number}.html"
                if (folder / address).is_file():
                    found.setdefault(capture.id, address)
    return found


def _made_with(row: BoardRow) -> dict[str, str]:
    """Say in words how the numbers of a row were made; empty where it is not known."""
    results = row.first
    captures = [capture for entry in row.entries for capture in entry.results.captures]
    cpu = [capture.cpu_seconds for capture in captures if capture.cpu_seconds is not None]
    seeds = ", ".join(str(seed) for seed in row.seeds)
    return provenance(results) | {
        "Suite, frames, seed": f"{results.suite}, {results.frames}, {seeds}",
        "Started": ", ".join(entry.results.started for entry in row.entries),
        "Protocol": ", ".join(results.protocols),
        "Seconds on one core": f"{sum(cpu) / len(cpu):.1f} a fit" if cpu else "",
        "Isolation": ", ".join(sorted({one.isolation for one in captures if one.isolation})),
        "Digest of the toolkit's code": str(results.environment.get("code", "")),
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
