"""Results in the pages of the documentation: tables and pictures written from result files.

A page has its blocks between `<!-- results: NAME -->` and `<!-- end -->`; `BLOCKS` has what writes
each of them from the board's entries and the logs of `benchmarks/`. Decibels outside of the blocks
need a source too (`find_faults`).
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.analysis.bootstrap import Estimate
from hwp_bench.analysis.columns import Filled, score_column, table_of
from hwp_bench.analysis.compare import contrasts
from hwp_bench.analysis.pairing import MACRO, MethodRuns, common_seeds
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write, read_json, sha256_json
from hwp_bench.base.tables import Column, Table, format_table, without_empty_columns
from hwp_bench.leaderboard.board import BoardRow, method_rows, ranks_of
from hwp_bench.leaderboard.rules import shipped_manifests, sound_entries, tables_of
from hwp_bench.leaderboard.submit import PLACE
from hwp_bench.leaderboard.suite_data import known_data
from hwp_bench.metrics import HWP_V1
from hwp_bench.report.figures import draw_leads, figure_file
from hwp_bench.report.study_tables import METRIC
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: The reference method, which every other one is compared with, and the plain fit.
OURS, PLAIN = "wildghand", "plain"
#: By how much another method must be ahead on a capture to be named, dB.
BEHIND = 0.5
#: Decibels that may stand outside of a block, by page: see `find_faults`.
TYPED = "docs/results.toml"
#: Where pictures of blocks lie; their names end in a digest of what they show.
PICTURES = "docs/pictures/field"

_BLOCK = re.compile(r"^<!-- results: (.+) -->\n(.*?)^<!-- end -->$", re.DOTALL | re.MULTILINE)
_DECIBELS = re.compile(r"[-+]?\d[\d.]*(?:(?:,| to| and| or)\s[-+]?\d[\d.]*)*\s+dB\b")
_STUDY = re.compile(r"\]\((?:\.\./)*(?:docs/)?studies/([\w-]+\.md)")


@dataclass(frozen=True)
class Sources:
    """Where results come from: a checkout of the repository."""

    #: Its folder.
    root: Path

    @cached_property
    def fields(self) -> list[Field]:
        """The methods of each suite that has entries of this version's protocol."""
        entries = sound_entries(self.root / PLACE)
        shown = {suite: own for (suite, name), own in tables_of(entries).items() if name == _NAME}
        return [Field(suite, tuple(method_rows(own))) for suite, own in shown.items()]


_NAME = HWP_V1.name


@dataclass(frozen=True)
class Field:
    """The methods on one suite."""

    #: Name of the suite.
    suite: str
    #: The row of each method.
    rows: tuple[BoardRow, ...]

    @cached_property
    def order(self) -> list[BoardRow]:
        """The rows, best first; those that lack a part of the suite at the end."""
        return sorted(self.rows, key=lambda row: (not row.whole, -row.scores[METRIC]))

    def row(self, name: str) -> BoardRow | None:
        """Return the whole row of a method by its name; None where there is none."""
        rows = (row for row in self.order if row.whole and row.first.method.name == name)
        return next(rows, None)

    @cached_property
    def others(self) -> list[BoardRow]:
        """The whole rows of other methods than `OURS`, best first."""
        return [row for row in self.order if row.whole and row.first.method.name != OURS]

    @cached_property
    def leads(self) -> dict[str, Estimate]:
        """`OURS` less each other method in the macro mean of `METRIC`, by the name of its row."""
        ours = self.row(OURS)
        if ours is None:
            return {}
        first, found = _runs(ours), {}
        for row in self.others:
            second = _runs(row)
            if first.seeds.keys() & second.seeds.keys():
                pair = ((1.0, first), (-1.0, second))
                seeds = common_seeds(first, second)
                (lead,) = contrasts(pair, METRIC, seeds, only=MACRO)
                found[row.name] = lead.estimate
        return found

    @cached_property
    def margins(self) -> dict[str, tuple[float, str]]:
        """By capture: `OURS` less the best other method in `METRIC`, and that one's title."""
        ours = self.row(OURS)
        if ours is None or not self.others:
            return {}
        others, best = [(row, _capture_means(row)) for row in self.others], {}
        for name, score in _capture_means(ours).items():
            highest, title = max((means[name], row.title) for row, means in others)
            best[name] = score - highest, title
        return best


def _runs(row: BoardRow) -> MethodRuns:
    return MethodRuns(row.title, {one.seed: one for one in row.compared})


def _capture_means(row: BoardRow) -> dict[str, float]:
    found: dict[str, list[float]] = {}
    for capture in row.captures:
        scores = [frame.scores[METRIC] for frame in capture.frames]
        found.setdefault(capture.id, []).append(float(np.mean(scores)))
    return {name: float(np.mean(values)) for name, values in found.items()}


@dataclass(frozen=True)
class Block:
    """The content of a block."""

    #: Markdown, without the markers.
    text: str
    #: What draws each of its pictures, by the path from the repository.
    pictures: Mapping[str, Callable[[], bytes]]


# --- the first page: a line a suite


def _headline(sources: Sources) -> Block:
    lines = [_headline_row(field) for field in sources.fields if field.row(OURS)]
    columns: list[Filled] = [(Column(name), [line[name] for line in lines]) for name in lines[0]]
    return Block(_markdown(table_of("PSNR of clean test frames, dB", columns)), {})


def _headline_row(field: Field) -> dict[str, str]:
    ours, plain = field.row(OURS), field.row(PLAIN)
    assert ours is not None
    best = field.others[0] if field.others else None
    lead = field.leads.get(best.name) if best else None
    return {
        "Suite": f"{field.suite}, {len(ours.first.captures)} captures",
        "WildGHand": f"{ours.scores[METRIC]:.2f}",
        "Best other": f"{best.title}, {best.scores[METRIC]:.2f}" if best else "–",
        "Plain fit": f"{plain.scores[METRIC]:.2f}" if plain else "–",
        "WildGHand ahead (95 %)": signed(lead) if lead else "–",
        "Methods": str(len(field.others) + 1),
        "Fit": ours.budget.split(", ")[0],
        "Seeds": str(len(ours.seeds)),
    }


def signed(estimate: Estimate) -> str:
    """Return a difference with its sign and its 95 % interval, where it has one."""
    text = f"{estimate.value:+.2f}"
    if estimate.low is None or estimate.high is None:
        return text
    return f"{text} ({estimate.low:+.2f} to {estimate.high:+.2f})"


def verdict_of(lead: Estimate | None) -> str:
    """Say what an interval of `OURS` less another method shows."""
    if lead is None or lead.low is None or lead.high is None:
        return "not known"
    return "ahead" if lead.low > 0 else "behind" if lead.high < 0 else "not told apart"


# --- the whole field: a section a suite


def _field(sources: Sources) -> Block:
    parts: list[str] = []
    pictures: dict[str, Callable[[], bytes]] = {}
    for field in sources.fields:
        text, drawn = _section(field)
        parts.append(text)
        pictures |= drawn
    return Block("\n\n".join(parts), pictures)


def _section(field: Field) -> tuple[str, dict[str, Callable[[], bytes]]]:
    _, sentence = ranks_of(field.rows)
    lines = [f"## {field.suite}", *_completeness(field), sentence, _captures_behind(field)]
    pictures: dict[str, Callable[[], bytes]] = {}
    if field.leads:
        leads = [(row.title, field.leads.get(row.name)) for row in field.others]
        shown = [(title, lead) for title, lead in leads if lead is not None]
        name = f"{field.suite}-{sha256_json([[t, vars(e)] for t, e in shown])[:8]}.svg"
        drawn = partial(draw_leads, "WildGHand", shown, METRIC)
        pictures[f"{PICTURES}/{name}"] = lambda: figure_file(drawn(), "svg")
        lines.append(f"![WildGHand less each other method on {field.suite}](pictures/field/{name})")
    lines += [_markdown(_field_table(field)), *_facts(field)]
    return "\n\n".join(line for line in lines if line), pictures


def _completeness(field: Field) -> list[str]:
    whole = {row.first.method.name for row in field.rows if row.whole}
    titles = {method.name: method.title for method in shipped_manifests()}
    missing = [title for name, title in titles.items() if name not in whole]
    count = len(titles) - len(missing)
    told = f"{count} of the {len(titles)} methods that ship are complete here: no capture and no "
    told += "test frame is missing."
    if missing:
        told += f" **A part of the field**: no complete run of {', '.join(missing)}."
    others = len(whole - titles.keys())
    return [told + (f" {others} other methods are on the board." if others else "")]


def _captures_behind(field: Field) -> str:
    if not field.margins:
        return ""
    worst, (least, title) = min(field.margins.items(), key=lambda item: item[1][0])
    behind = [
        f"{name} ({margin:+.2f} dB, {other})"
        for name, (margin, other) in field.margins.items()
        if margin < -BEHIND
    ]
    if behind:
        return (
            f"WildGHand is behind the best other method by more than {BEHIND:g} dB on "
            f"{len(behind)} of {len(field.margins)} captures: {', '.join(behind)}."
        )
    return (
        f"On no capture is WildGHand behind the best other method by more than {BEHIND:g} dB. The "
        f"closest is {worst}: {least:+.2f} dB against {title}."
    )


def _field_table(field: Field) -> Table:
    order = field.order
    leads = [field.leads.get(row.name) for row in order]
    ours = [row.first.method.name == OURS for row in order]
    columns: list[Filled] = [
        (Column("Method"), [row.title for row in order]),
        (Column("Training data"), [row.training_text for row in order]),
        (score_column(METRIC), [row.scores[METRIC] for row in order]),
        (Column("WildGHand ahead (95 %)"), [signed(lead) if lead else None for lead in leads]),
        (
            Column("WildGHand is"),
            [None if own else verdict_of(lead) for own, lead in zip(ours, leads, strict=True)],
        ),
    ]
    for name in ("ssim", "oriented_distance", "flip", "lpips_alex"):
        columns.append((score_column(name), [row.scores.get(name) for row in order]))
    for name in PERTURBATIONS:
        heading = Column(f"PSNR: {perturbation(name).title}", 2, higher_is_better=True)
        columns.append((heading, [row.scopes.get(name, {}).get(METRIC) for row in order]))
    columns += [
        (Column("PSNR: novel views", 2, True), [_novel_views(row) for row in order]),
        (Column("Fit [s]", 1), [row.fit_seconds for row in order]),
        (Column("Seeds", 0), [len(row.seeds) for row in order]),
        (Column("Complete"), ["yes" if row.whole else "no" for row in order]),
    ]
    lacking = frozenset(place for place, row in enumerate(order) if not row.whole)
    note = "Each interval speaks of one pair of methods, over the seeds that both have."
    return without_empty_columns(table_of(field.suite, columns, [note], unranked=lacking))


def _novel_views(row: BoardRow) -> float | None:
    """Mean over captures of the mean over a free-view clip; None where there is none."""
    clips = [capture.free_view for capture in row.captures if capture.free_view is not None]
    means = [np.mean([frame.scores[METRIC] for frame in clip.frames]) for clip in clips]
    return float(np.mean(means)) if means else None


def _facts(field: Field) -> list[str]:
    """Say how the numbers were made, as a list; what all rows share is said once."""
    rows = field.order
    started = sorted(entry.results.started[:10] for row in rows for entry in row.entries)
    frames = sum(len(capture.frames) for capture in rows[0].first.captures)
    facts = {
        "Captures": f"{len(rows[0].first.captures)}, with {frames} test frames",
        "Budget": _shared(rows, lambda row: [row.budget]),
        "Seeds": _shared(rows, lambda row: [", ".join(map(str, row.seeds))]),
        "Machine": _shared(rows, _machines),
        "Runs": " to ".join(dict.fromkeys((started[0], started[-1]))),
        "Commit": _shared(rows, lambda row: _environment(row, "commit")),
        "Toolkit's code": _shared(rows, lambda row: [c[:8] for c in _environment(row, "code")]),
        "Renderer": _renderer(rows),
        "Validation frames serve": _shared(rows, _validation),
        "Checked": _shared(rows, lambda row: [row.level]),
    }
    return ["\n".join(f"- **{name}**: {text}" for name, text in facts.items() if text)]


def _shared(rows: Sequence[BoardRow], facts: Callable[[BoardRow], Iterable[str]]) -> str:
    """Return a fact of all rows; where they differ, with the number of methods or their titles."""
    groups: dict[str, list[str]] = {}
    for row in rows:
        text = ", ".join(dict.fromkeys(fact for fact in facts(row) if fact)) or "not recorded"
        groups.setdefault(text, []).append(row.title)
    if len(groups) == 1:
        return next(iter(groups))
    most = max(groups, key=lambda text: len(groups[text]))
    parts = [
        f"{text} ({'the others' if text == most else ', '.join(titles)})"
        for text, titles in sorted(groups.items(), key=lambda group: group[0] == most)
    ]
    return "; ".join(parts)


def _environment(row: BoardRow, name: str) -> list[str]:
    found = [str(entry.counted.environment.get(name) or "") for entry in row.entries]
    return list(dict.fromkeys(found))


def _machines(row: BoardRow) -> list[str]:
    made = [entry.counted for entry in row.entries]
    devices = {str(c.device) for one in made for c in one.captures if c.device not in (None, "cpu")}
    names = [
        f"{one.environment.get('processor', '?')}, {one.environment.get('cores', '?')} cores"
        for one in made
    ]
    return [*dict.fromkeys(names), *sorted(devices)]


def _validation(row: BoardRow) -> list[str]:
    uses = row.first.method.validation
    return [] if uses is None else [", ".join(uses) or "nothing"]


def _renderer(rows: Sequence[BoardRow]) -> str:
    """The version of the renderer where all captures are of it; else that some are of others."""
    data = known_data()
    known = data.suites.get(rows[0].suite)
    if not known:
        return ""
    latest = {version.digest for one in known.values() for version in _latest(one)}
    found = {capture.digest in latest for row in rows for capture in row.captures}
    return f"{data.renderer}" if found == {True} else f"{data.renderer} and earlier ones"


def _latest(data: Any) -> list[Any]:
    return [one for one in (data.current, *data.others) if one is not None]


# --- logs of the benchmarks


def _ratios(sources: Sources) -> Block:
    """The stored ratios of `benchmarks/ratios.json`."""
    found = read_json(sources.root / "benchmarks" / "ratios.json")["benchmarks"]
    rows = [(one, ratio) for one in found for ratio in one["ratios"]]
    columns: list[Filled] = [
        (Column("Ratio of two times"), [ratio["name"] for _, ratio in rows]),
        (Column("Value", 2), [ratio["ratio"] for _, ratio in rows]),
        (Column("Command"), [one["command"] for one, _ in rows]),
        (Column("Machine"), [one["machine"] for one, _ in rows]),
        (Column("Commit and day"), [one.get("measured") or "not recorded" for one, _ in rows]),
    ]
    return Block(_markdown(table_of("Stored ratios", columns)), {})


def _tuning(sources: Sources, method: str) -> Block:
    """The logged trials of a baseline (`benchmarks/tuning.jsonl`), next to the plain fit."""
    lines = (sources.root / "benchmarks" / "tuning.jsonl").read_text("utf-8").splitlines()
    fits = [json.loads(line) for line in lines]
    found = [_trials(fits, method, limits) for limits in dict.fromkeys(map(_limits, fits))]
    return Block("\n\n".join(_markdown(table) for table in found if table) or "No trial.", {})


def _limits(fit: Mapping[str, Any]) -> str:
    return f"{fit['limit']} a fit, preset {fit['preset']}, seed {fit['seed']}"


def _trials(fits: Sequence[Mapping[str, Any]], method: str, limits: str) -> Table | None:
    """Return a row for each trial of a baseline under some limits; None where there is none."""
    own = [fit for fit in fits if _limits(fit) == limits and fit["method"] == method]
    captures = list(dict.fromkeys(fit["capture"] for fit in own))
    if method != PLAIN:
        alike = [fit for fit in fits if _limits(fit) == limits and fit["method"] == PLAIN]
        own += [fit for fit in alike if not fit["trial"] and fit["capture"] in captures]
    rows: dict[str, dict[str, float]] = {}
    for fit in own:
        trial = "preset" if fit["method"] == method else "the plain fit"
        rows.setdefault(fit["trial"].replace(",", " ") or trial, {})[fit["capture"]] = fit["score"]
    if not captures:
        return None
    means = [
        float(np.mean(list(row.values()))) if len(row) == len(captures) else None
        for row in rows.values()
    ]
    columns: list[Filled] = [
        (Column("Settings"), list(rows)),
        *((Column(name, 2), [row.get(name) for row in rows.values()]) for name in captures),
        (Column("Mean", 2, higher_is_better=True), means),
    ]
    made = dict.fromkeys(f"{fit['commit']}, {fit['day']}, {fit['machine']}" for fit in own)
    note = f"Commit, day, machine: {'; '.join(made)}."
    return table_of(f"Mean PSNR of validation frames, dB; {limits}", columns, [note])


#: What writes each block, by the first word of its name; further words are arguments.
BLOCKS: Mapping[str, Callable[..., Block]] = {
    "headline": _headline,
    "field": _field,
    "ratios": _ratios,
    "tuning": _tuning,
}


def _markdown(table: Table) -> str:
    return format_table(table, "md").strip()


# --- pages


def pages_of(root: Path) -> list[Path]:
    """Return the pages that may have results: the README, the documentation, the baselines'."""
    docs = sorted((root / "docs").rglob("*.md"))
    return [root / "README.md", *docs, *sorted((root / "baselines").glob("*/README.md"))]


def make_pages(root: Path) -> dict[Path, str | Callable[[], bytes]]:
    """Return the pages with blocks as they should be, and what draws their pictures, by file.

    Raises:
        UsageError: not a checkout of the repository, or a block has a name that is not known.
    """
    if not (root / "docs").is_dir() or not (root / PLACE).is_dir():
        raise UsageError(
            "is not a checkout of the repository",
            where=root,
            field="--root",
            remedy="It has the pages and the entries: clone it.",
        )
    sources = Sources(root)
    made: dict[Path, str | Callable[[], bytes]] = {}
    blocks: dict[str, Block] = {}
    for page in pages_of(root):
        text = page.read_text("utf-8")
        names = [found[1] for found in _BLOCK.finditer(text)]
        for name in names:
            kind, *words = name.split()
            if kind not in BLOCKS:
                problem = f"{kind!r} is not a block of results"
                remedy = f"Known: {', '.join(BLOCKS)}."
                raise UsageError(problem, where=page, field="results", remedy=remedy)
            if name not in blocks:
                blocks[name] = BLOCKS[kind](sources, *words)
        if names:
            made[page] = _BLOCK.sub(lambda found: _filled(found[1], blocks), text)
    for block in blocks.values():
        made |= {root / path: draw for path, draw in block.pictures.items()}
    return made


def _filled(name: str, blocks: Mapping[str, Block]) -> str:
    return f"<!-- results: {name} -->\n{blocks[name].text}\n<!-- end -->"


def write_pages(root: Path) -> list[Path]:
    """Write blocks and pictures that differ; pictures of other numbers are removed."""
    made = make_pages(root)
    written = []
    for file, content in made.items():
        if isinstance(content, str) and file.read_text("utf-8") == content:
            continue
        if not isinstance(content, str) and file.is_file():
            continue
        data = content if isinstance(content, str) else content()
        written.append(atomic_write(file, data, overwrite=True))
    for old in (root / PICTURES).glob("*.svg"):
        if old not in made:
            old.unlink()
    return written


def find_faults(root: Path) -> list[str]:
    """Return what is wrong with results in pages, a line each; none where all is well.

    A block must be what its source says, and its pictures must be there. A decibel outside of
    the blocks of a page for users must stand in the study that its paragraph leads to, or be listed
    for the page in `TYPED`: as a definition, or as one that no file says yet.
    """
    faults = []
    for file, content in make_pages(root).items():
        place = file.relative_to(root)
        if isinstance(content, str) and file.read_text("utf-8") != content:
            faults.append(f"{place}: a block is not what its source says")
        elif not isinstance(content, str) and not file.is_file():
            faults.append(f"{place}: is missing")
    typed: dict[str, Any] = tomllib.loads((root / TYPED).read_text("utf-8"))
    studies = root / "docs" / "studies"
    for page in pages_of(root):
        key = _key(page)
        if page.parent == studies or key in typed["generated"]:
            continue
        known = {*typed["definitions"].get(key, ()), *typed["unsourced"].get(key, ())}
        for line, number in _without_source(page.read_text("utf-8"), studies):
            if number not in known:
                faults.append(f"{page.relative_to(root)}:{line}: {number!r} has no source")
    return faults


def _key(page: Path) -> str:
    """How a page is called in `TYPED`, wherever it lies below `docs`."""
    return (
        f"{page.parent.name}/{page.name}" if page.parent.parent.name == "baselines" else page.name
    )


def _without_source(text: str, studies: Path) -> Iterator[tuple[int, str]]:
    """Line and text of decibels outside of blocks that no linked study has."""
    text = _BLOCK.sub(lambda found: "\n" * found[0].count("\n"), text)
    line = 1
    for paragraph in re.split(r"(\n\s*\n)", text):
        linked = [studies / name for name in _STUDY.findall(paragraph)]
        known = " ".join(file.read_text("utf-8") for file in linked if file.is_file())
        for found in _DECIBELS.finditer(paragraph):
            number = " ".join(found[0].split())
            if number not in " ".join(known.split()):
                yield line + paragraph[: found.start()].count("\n"), number
        line += paragraph.count("\n")
