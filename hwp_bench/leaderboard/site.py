"""The leaderboard's site: the board, pictures, a page for each method and a report for each row."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markdown_it import MarkdownIt
from markupsafe import Markup

from hwp_bench.base.drawing import error_map, fitted
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_folder, canonical_json, sha256_json
from hwp_bench.capture import Capture
from hwp_bench.evaluation.artifacts import square_around
from hwp_bench.evaluation.scoring import read_prediction
from hwp_bench.leaderboard.board import (
    METRICS,
    SCOPES,
    BoardRow,
    MethodRow,
    Row,
    budget_text,
    curve_plot,
    make_row,
    method_rows,
    rank_interval,
    ranks_of,
    reference_lead,
    severities_of,
)
from hwp_bench.leaderboard.entries import BADGES, LEVEL_TEXTS, Entry, digest
from hwp_bench.leaderboard.rules import SUITES, check_entries, source_of, tables_of
from hwp_bench.methods.manifest import shipped_methods
from hwp_bench.metrics import HWP_V1
from hwp_bench.metrics import metric as metric_facts
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.report.page import provenance, render_template, style_sheet, write_report
from hwp_bench.report.sources import ResultsSource, open_captures_of
from hwp_bench.results import CaptureResult, Results
from hwp_bench.results.published import NOTE, read_published

#: Test frames of each capture that are shown at most, evenly spread.
FRAMES = 6
#: Edge of a picture, px.
EDGE = 384
#: Quality of JPEG; a picture of this edge takes some 12 kB.
QUALITY = 82


@dataclass(frozen=True)
class Shot:
    """The drawing of one frame by one method."""

    #: Name of the entry.
    entry: str
    #: Title of the method, with its budget.
    title: str
    #: The drawing and its error map, as addresses within the site.
    picture: str
    error: str
    #: PSNR of the frame, dB.
    psnr: float


@dataclass(frozen=True)
class Scene:
    """One test frame of one capture."""

    #: The capture's id, with the suite where several suites have one of this name.
    capture: str
    #: The frame's index.
    frame: int
    #: The truth, as an address within the site.
    truth: str
    #: Methods, the best of the suite first: not of the frame, whose scores stand with its pictures.
    shots: tuple[Shot, ...]


def write_gallery(
    folder: Path,
    sources: Sequence[tuple[Entry, ResultsSource]],
    captures: Mapping[str, Capture],
    titles: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Draw every method on a few test frames of every capture, on the scored pixels.

    Nobody chooses the frames: they are evenly spread over the test clip.

    Args:
        folder: of the site; pictures go into `pictures` within.
        sources: entries with the folders of their results.
        captures: by digest; others have no truth to show and are left out.
        titles: how a method is called in lists, by the name of its entry.

    Returns:
        `Scene`s as JSON values, in the order of the suites, the captures and frames.
    """
    by_capture: dict[tuple[str, str], list[tuple[Entry, ResultsSource, CaptureResult]]] = {}
    ranked = sorted(sources, key=lambda pair: -pair[0].results.scores["psnr"])
    for entry, source in ranked:
        for result in source.results.captures:
            if result.digest in captures:
                key = (source.results.suite, result.digest)
                by_capture.setdefault(key, []).append((entry, source, result))
    order = sorted(by_capture, key=lambda key: _place(key[0], captures[key[1]].info.id))
    ids = [captures[data].info.id for _, data in order]
    scenes = []
    for suite, data in order:
        capture = captures[data]
        several = ids.count(capture.info.id) > 1
        name = f"{capture.info.id} of {suite}" if several else capture.info.id
        scenes += _scenes(folder, capture, name, by_capture[suite, data], titles)
    return [asdict(scene) for scene in scenes]


def _place(suite: str, identifier: str) -> tuple[int, int, str]:
    """The place of a capture in lists: `capture10` comes after `capture9`."""
    return SUITES.index(suite), len(identifier), identifier


def _scenes(
    folder: Path,
    capture: Capture,
    name: str,
    found: Sequence[tuple[Entry, ResultsSource, CaptureResult]],
    titles: Mapping[str, str],
) -> list[Scene]:
    common = set.intersection(*({item.frame for item in row.frames} for _, _, row in found))
    # The name of a folder is made of a digest: a capture's own id comes from outside.
    place = f"pictures/{sha256_json(capture.info.to_json())[:12]}"
    (folder / place).mkdir(parents=True, exist_ok=True)
    scenes = []
    for frame in _spread(sorted(common)):
        target = capture.frame(frame)
        mask, exact = capture.scoring_mask(frame)
        region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        box = square_around(region)
        truth = f"{place}/{frame}-truth.jpg"
        _write(folder / truth, np.where(region[..., None], target, 0)[box])
        shots = []
        for entry, source, result in found:
            predictions = source.place(result.id, "predictions")
            pixels = None
            if predictions is not None:
                pixels = read_prediction(predictions, frame, capture.size).pixels
            if pixels is None:
                continue
            picture, error = (
                f"{place}/{frame}-{digest(entry.results)[:12]}{end}.jpg" for end in ("", "-e")
            )
            _write(folder / picture, np.where(region[..., None], pixels, 0)[box])
            _write(folder / error, error_map(pixels, target, region)[box])
            psnr = next(item.scores["psnr"] for item in result.frames if item.frame == frame)
            shots.append(Shot(entry.name, titles[entry.name], picture, error, psnr))
        if shots:
            scenes.append(Scene(name, frame, truth, tuple(shots)))
    return scenes


def _spread(frames: Sequence[int]) -> list[int]:
    """At most `FRAMES` of some frames, evenly spread, the first and the last among them."""
    if len(frames) <= FRAMES:
        return list(frames)
    return [frames[round(k * (len(frames) - 1) / (FRAMES - 1))] for k in range(FRAMES)]


def _write(path: Path, image: np.ndarray) -> None:
    """Write a JPEG; the folder is a temporary one, so that a half of it is never seen."""
    shown = cv2.cvtColor(fitted(np.ascontiguousarray(image), EDGE), cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    path.write_bytes(data.tobytes())


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
