"""Results in the pages of the documentation: tables and pictures written from result files.

A page has its blocks between `<!-- results: NAME -->` and `<!-- end -->`; `BLOCKS` has what writes
each of them from the board's entries and the logs of `benchmarks/`. Decibels outside of the blocks
need a source too (`find_faults`).
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from statistics import fmean
from typing import Any

from hwp_bench.analysis.bootstrap import Estimate
from hwp_bench.analysis.columns import Filled, score_column, table_of
from hwp_bench.analysis.compare import ALPHA, contrasts, holm
from hwp_bench.analysis.pairing import MACRO, MethodRuns
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write, read_json, sha256_json
from hwp_bench.base.tables import Column, Table, format_table, without_empty_columns
from hwp_bench.evaluation.sentences import ALONE
from hwp_bench.leaderboard.board import BoardRow, method_rows, ranks_of
from hwp_bench.leaderboard.rules import shipped_manifests, sound_entries, tables_of
from hwp_bench.leaderboard.submit import PLACE
from hwp_bench.leaderboard.suite_data import known_data
from hwp_bench.metrics import HWP_V1
from hwp_bench.report.figures import draw_leads, figure_file
from hwp_bench.report.study_tables import METRIC
from hwp_bench.results import Results
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: The reference method, which every other one is compared with, and the plain fit.
OURS, PLAIN = "wildghand", "plain"
#: By how much another method must be ahead on a capture to be named, dB.
BEHIND = 0.5
#: The suites that are shown first: the one that nothing was tuned on, and the real one.
_FIRST = ("wild-test", "real-1")
#: Decibels that may stand outside of a block, by page: see `find_faults`.
TYPED = "docs/results.toml"
#: Where pictures of blocks lie; their names end in a digest of what they show.
PICTURES = "docs/pictures/field"
_UNDECLARED = (
    "Some of these runs do not say what validation frames served for: they are older than early "
    "stopping for every method."
)

_BLOCK = re.compile(r"^<!-- results: ([^\n]+) -->\n(.*?)^<!-- end -->$", re.DOTALL | re.MULTILINE)
_DIGEST = re.compile(r"<!-- digest: \w{64} -->\s*\Z")
_DECIBELS = re.compile(r"[-+]?\d[\d.]*(?:(?:,| to| and| or)\s[-+]?\d[\d.]*)*\s+dB\b")
_STUDY = re.compile(r"\]\((?:\.\./)*(?:docs/)?studies/([\w-]+\.md)")


@dataclass(frozen=True)
class Sources:
    """Where results come from: a checkout of the repository."""

    #: Its folder.
    root: Path
    #: What draws the pictures of the blocks that were made, by file.
    pictures: dict[Path, Callable[[], bytes]] = field(default_factory=dict)

    @cached_property
    def fields(self) -> list[Field]:
        """The methods of each suite that has entries of this version's protocol."""
        tables = tables_of(sound_entries(self.root / PLACE)).items()
        own = {suite: entries for (suite, name), entries in tables if name == HWP_V1.name}
        order = sorted(own, key=lambda suite: (*_FIRST, suite).index(suite))
        return [Field(suite, method_rows(own[suite])) for suite in order]


class Field:
    """The methods on one suite, best first; those that lack a part of it at the end."""

    def __init__(self, suite: str, rows: Sequence[BoardRow]) -> None:
        self.suite = suite
        self.rows = sorted(rows, key=lambda row: (not row.whole, -row.scores[METRIC]))
        whole = [row for row in self.rows if row.whole]
        self.named = {row.first.method.name: row for row in whole}
        self.ours = self.named.get(OURS)
        self.others = [row for row in whole if row is not self.ours]

    @cached_property
    def leads(self) -> dict[str, Estimate]:
        """`OURS` less each other method in the macro mean of `METRIC`, by the name of its row."""
        found = {}
        for row in self.others if self.ours else ():
            first, second = (_by_seed(one) for one in (self.ours, row) if one)
            if seeds := sorted(first.seeds.keys() & second.seeds.keys()):
                terms = (1.0, first), (-1.0, second)
                found[row.name] = contrasts(terms, METRIC, seeds, only=MACRO)[0].estimate
        return found

    @cached_property
    def margins(self) -> list[tuple[float, str, str]]:
        """`OURS` less the best other method on each capture in `METRIC`, its id, that one's title.

        The least is the first.
        """
        others, found = [(_capture_means(row), row.title) for row in self.others], []
        for name, score in _capture_means(self.ours).items() if self.ours and others else ():
            best, title = max((means[name], title) for means, title in others)
            found.append((score - best, name, title))
        return sorted(found)


def _by_seed(row: BoardRow) -> MethodRuns:
    return MethodRuns(row.title, {one.seed: one for one in row.compared})


def _capture_means(row: BoardRow) -> dict[str, float]:
    found: dict[str, list[float]] = {}
    for capture in row.captures:
        scores = [frame.scores[METRIC] for frame in capture.frames]
        found.setdefault(capture.id, []).append(fmean(scores))
    return {name: fmean(values) for name, values in found.items()}


def signed(estimate: Estimate | None) -> str | None:
    """Return a difference with its sign and its 95 % interval, where it has one."""
    if estimate is None:
        return None
    known = estimate.low is not None and estimate.high is not None
    ends = f" ({estimate.low:+.2f} to {estimate.high:+.2f})" if known else ""
    return f"{estimate.value:+.2f}{ends}"


def verdict_of(lead: Estimate | None) -> str | None:
    """Say what an interval of `OURS` less another method shows."""
    if lead is None or lead.low is None or lead.high is None:
        return None
    return "ahead" if lead.low > 0 else "behind" if lead.high < 0 else "not significant"


# --- the blocks: a line a suite, and a section a suite


def _headline(sources: Sources) -> str:
    # One other method is not a field.
    shown = [one for one in sources.fields if len(one.others) > 1]
    rows = [(one, one.ours, one.others[0]) for one in shown if one.ours]
    plain = [one.named.get(PLAIN) for one, _, _ in rows]
    best = [f"{other.title}, {other.scores[METRIC]:.2f}" for _, _, other in rows]
    suites = [f"{one.suite}, {len(our.first.captures)} captures" for one, our, _ in rows]
    columns: list[Filled] = [
        (Column("Suite"), suites),
        (Column("WildGHand"), [our.scores[METRIC] for _, our, _ in rows]),
        (Column("Best other"), best),
        (Column("Plain fit"), [row.scores[METRIC] if row else None for row in plain]),
        (
            Column("WildGHand ahead (95 %)"),
            [signed(one.leads.get(other.name)) for one, _, other in rows],
        ),
        (Column("Methods"), [len(one.named) for one, _, _ in rows]),
        (Column("Fit"), [our.budget.split(", ")[0] for _, our, _ in rows]),
        (Column("Seeds"), [_seeds(one) for one, _, _ in rows]),
    ]
    return _markdown(table_of("PSNR of clean test frames, dB", columns))


def _seeds(one: Field) -> str:
    """The least and the most seeds of a method."""
    counts = sorted(len(row.seeds) for row in one.named.values())
    return " to ".join(dict.fromkeys((str(counts[0]), str(counts[-1]))))


def _field(sources: Sources) -> str:
    return "\n\n".join(_section(one, sources) for one in sources.fields)


def _section(one: Field, sources: Sources) -> str:
    told = ranks_of(one.rows)[1]
    chosen = f"With the leader that the scores choose: {told}" if told else ""
    lines = [
        f"## {one.suite}",
        _completeness(one),
        against_each(one),
        chosen,
        _captures_behind(one),
        _UNDECLARED
        if any(row.first.method.validation is None for row in one.named.values())
        else "",
    ]
    if one.leads:
        titles = {row.name: row.title for row in one.others}
        shown = [(titles[name], lead) for name, lead in one.leads.items()]
        name = f"{one.suite}-{sha256_json([[t, vars(e)] for t, e in shown])[:8]}.svg"
        draw = partial(draw_leads, "WildGHand", shown, METRIC)
        sources.pictures[sources.root / PICTURES / name] = lambda: figure_file(draw(), "svg")
        lines.append(f"![WildGHand less each other method on {one.suite}](pictures/field/{name})")
    lines += [_markdown(_field_table(one)), _facts(one.rows)]
    return "\n\n".join(line for line in lines if line)


def _completeness(one: Field) -> str:
    titles = {method.name: method.title for method in shipped_manifests()}
    missing = [title for name, title in titles.items() if name not in one.named]
    told = f"{len(titles) - len(missing)} of the {len(titles)} methods that ship are complete here."
    if missing:
        told += f" **Incomplete**: no complete run of {', '.join(missing)}."
    return told


def against_each(one: Field) -> str:
    """Say which methods `OURS` is ahead of, as the method that was named before the runs.

    That it is ahead of all of them needs each pair to tell, at 5 % without an allowance for
    their number: an intersection-union test (Berger, Multiparameter hypothesis testing and
    acceptance sampling, 1982). How many it is ahead of, where not of all, is Holm's.
    """
    pairs = [(row.title, one.leads[row.name]) for row in one.others if row.name in one.leads]
    told = [(title, lead) for title, lead in pairs if lead.p is not None]
    if not told:
        return ""
    ours, others = "WildGHand, named before the runs, is significantly ahead of", len(one.others)
    if sum(verdict_of(lead) == "ahead" for _, lead in told) < others:
        adjusted = holm([lead.p or 0.0 for _, lead in told])
        differing = [pair for pair, p in zip(told, adjusted, strict=True) if p < ALPHA]
        ahead = sum(lead.value > 0 for _, lead in differing)
        beaten_by = ", ".join(title for title, lead in differing if lead.value < 0) or "none"
        allowed = f" (Holm over the {len(told)} pairs)" if told[1:] else ""
        return f"{ours} {ahead} of the {others} others, and behind {beaten_by}{allowed}."
    if others == 1:
        return f"{ours} the other: {signed(told[0][1])} dB."
    title, lead = max(told, key=lambda pair: pair[1].p or 0.0)
    return f"{ours} all {others} others; least surely of {title}: {signed(lead)} dB."


def _captures_behind(one: Field) -> str:
    if not one.margins:
        return ""
    texts = [f"{name} ({margin:+.2f} dB, {title})" for margin, name, title in one.margins]
    behind = [text for text, found in zip(texts, one.margins, strict=True) if found[0] < -BEHIND]
    if not behind:
        none = f"On no capture is WildGHand behind the best other method by more than {BEHIND:g} dB"
        return f"{none}. Nearest to it is {texts[0]}."
    return (
        f"WildGHand is behind the best other method by more than {BEHIND:g} dB on {len(behind)} of "
        f"{len(texts)} captures: {', '.join(behind)}."
    )


def _field_table(one: Field) -> Table:
    rows = one.rows
    leads = [one.leads.get(row.name) for row in rows]
    columns: list[Filled] = [
        (Column("Method"), [row.title for row in rows]),
        (Column("Training data"), [row.training_text for row in rows]),
        (score_column(METRIC), [row.scores[METRIC] for row in rows]),
        (Column("WildGHand ahead (95 %)"), [signed(lead) for lead in leads]),
        (Column("WildGHand is"), [verdict_of(lead) for lead in leads]),
    ]
    for name in ("ssim", "oriented_distance", "flip", "lpips_alex"):
        columns.append((score_column(name), [row.scores.get(name) for row in rows]))
    for name in PERTURBATIONS:
        head = Column(f"PSNR: {perturbation(name).title}", 2, higher_is_better=True)
        columns.append((head, [row.scopes.get(name, {}).get(METRIC) for row in rows]))
    columns += [
        (Column("PSNR: novel views", 2, True), _novel_views(rows)),
        (Column("Fit [s]", 1), [row.fit_seconds for row in rows]),
        (Column("Seeds", 0), [len(row.seeds) for row in rows]),
        (Column("Complete"), ["yes" if row.whole else "no" for row in rows]),
    ]
    lacking = frozenset(place for place, row in enumerate(rows) if not row.whole)
    note = "Each interval speaks of one pair of methods, over the seeds that both have."
    return without_empty_columns(
        table_of(f"Methods on {one.suite}", columns, [note], unranked=lacking)
    )


def _novel_views(rows: Sequence[BoardRow]) -> list[float | None]:
    """Mean over captures of the mean over a free-view clip, of each row.

    None where a row has another clip of a capture than most rows, or none: its mean would be of
    other frames.
    """
    captures = [capture for row in rows for capture in row.captures]
    counts = Counter((c.id, c.free_view.digest) for c in captures if c.free_view)
    usual = dict(clip for clip, _ in reversed(counts.most_common()))
    means: list[float | None] = []
    for row in rows:
        clips = [c.free_view for c in row.captures if c.id in usual]
        same = {c.id: c.free_view.digest for c in row.captures if c.free_view} == usual
        found = [fmean(frame.scores[METRIC] for frame in clip.frames) for clip in clips if clip]
        means.append(fmean(found) if found and same else None)
    return means


def _facts(rows: Sequence[BoardRow]) -> str:
    """Say how the numbers were made, as a list."""
    first, days = rows[0].first, sorted({one.started[:10] for row in rows for one in row.runs})
    frames = sum(len(capture.frames) for capture in first.captures)
    facts = {
        "Captures": f"{len(first.captures)}, with {frames} test frames",
        "Budget": _shared(rows, lambda row: [row.budget]),
        "Seeds": _shared(rows, lambda row: map(str, row.seeds)),
        "Machine": _shared(rows, lambda row: map(_machine, row.runs)),
        "Cores that a fit used": _cores(rows),
        "Fits that shared their core": _disturbed(rows),
        "Fits beyond their budget": _late(rows),
        "Runs": " to ".join(dict.fromkeys((days[0], days[-1]))),
        "Commit": _shared(rows, lambda row: _environment(row, "commit")),
        "Toolkit's code": _shared(
            rows, lambda row: [code[:8] for code in _environment(row, "code")]
        ),
        "Renderer": _renderer(rows),
        "Validation frames serve": _shared(rows, lambda row: row.first.method.validation or ()),
        "Checked": _shared(rows, lambda row: [row.level]),
    }
    return "\n".join(f"- **{name}**: {text}" for name, text in facts.items() if text)


def _shared(rows: Sequence[BoardRow], facts: Callable[[BoardRow], Iterable[str]]) -> str:
    """Return a fact of all rows; where they differ, with the titles of those of each fact."""
    groups: dict[str, list[str]] = {}
    for row in rows:
        text = ", ".join(dict.fromkeys(fact for fact in facts(row) if fact)) or "not recorded"
        groups.setdefault(text, []).append(row.title)
    *fewer, (most, _) = sorted(groups.items(), key=lambda group: len(group[1]))
    told = [f"{text} ({', '.join(titles)})" for text, titles in fewer]
    return "; ".join([*told, f"{most} (the others)" if fewer else most])


def _timed(row: BoardRow) -> list[float]:
    """The mean number of cores that each fit on the CPU used."""
    return [
        one.cpu_seconds / one.fit_seconds
        for one in row.captures
        if one.device == "cpu" and one.cpu_seconds and one.fit_seconds
    ]


def _cores(rows: Sequence[BoardRow]) -> str:
    """The least and the most cores that the fits of a row used on average."""
    means = [fmean(shares) for shares in map(_timed, rows) if shares]
    return f"{min(means):.2f} to {max(means):.2f}" if means else ""


def _disturbed(rows: Sequence[BoardRow]) -> str:
    """The rows with fits that had less than a core, and how many of each."""
    counts = {row.title: [share < ALONE for share in _timed(row)] for row in rows}
    told = [f"{sum(few)} of {len(few)} ({title})" for title, few in counts.items() if any(few)]
    return ", ".join(told)


def _late(rows: Sequence[BoardRow]) -> str:
    """The rows with fits that took more than a second over their budget, and how many of each."""
    told = []
    for row in rows:
        limit = row.first.budget.get("seconds") or math.inf
        fits = [one.fit_seconds for one in row.captures if one.fit_seconds]
        if late := [seconds for seconds in fits if seconds > limit + 1.0]:
            told.append(f"{len(late)} of {len(fits)}, up to {max(late):.1f} s ({row.title})")
    return "; ".join(told)


def _environment(row: BoardRow, name: str) -> list[str]:
    return [str(one.environment.get(name) or "") for one in row.runs]


def _machine(results: Results) -> str:
    facts = results.environment
    devices = {str(c.device) for c in results.captures if c.device not in (None, "cpu")}
    cores = f"{facts.get('cores', '?')} cores"
    return ", ".join([str(facts.get("processor", "?")), cores, *sorted(devices)])


def _renderer(rows: Sequence[BoardRow]) -> str:
    """The version of the renderer of the captures; empty for real clips."""
    data = known_data()
    known = data.suites.get(rows[0].suite, {}).values()
    latest = {version.digest for one in known for version in (one.current, *one.others) if version}
    former = any(capture.digest not in latest for row in rows for capture in row.captures)
    return (f"{data.renderer} and earlier ones" if former else str(data.renderer)) if known else ""


# --- logs of the benchmarks


def _ratios(sources: Sources) -> str:
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
    return _markdown(table_of("Stored ratios", columns))


def _stages(sources: Sources) -> str:
    """The stages of `wildghand fit VIDEO` (`benchmarks/video_stages.jsonl`)."""
    lines = (sources.root / "benchmarks" / "video_stages.jsonl").read_text("utf-8").splitlines()
    fits = [json.loads(line) for line in lines]
    names = list(dict.fromkeys(name for fit in fits for name in fit["stages"]))
    columns: list[Filled] = [
        (Column("Video"), [fit["video"] + ", quick" * fit["quick"] for fit in fits]),
        (Column("Frames"), [fit["frames"] for fit in fits]),
        (Column("All, s"), [round(fit["seconds"]) for fit in fits]),
        *((Column(f"{name}, s"), [round(fit["stages"][name]) for fit in fits]) for name in names),
        (Column("Machine, day"), [f"{fit['machine']}, {fit['day']}" for fit in fits]),
    ]
    return _markdown(table_of("Seconds of wildghand fit, by stage", columns))


def _tuning(sources: Sources, method: str) -> str:
    """The logged trials of a baseline (`benchmarks/tuning.jsonl`), next to the plain fit."""
    lines = (sources.root / "benchmarks" / "tuning.jsonl").read_text("utf-8").splitlines()
    fits = [json.loads(line) for line in lines]
    found = [_trials(fits, method, limits) for limits in dict.fromkeys(map(_limits, fits))]
    return "\n\n".join(_markdown(table) for table in found if table) or "No trial is logged."


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
    means = [fmean(row.values()) if len(row) == len(captures) else None for row in rows.values()]
    columns: list[Filled] = [
        (Column("Settings"), list(rows)),
        *((Column(name, 2), [row.get(name) for row in rows.values()]) for name in captures),
        (Column("Mean", 2, higher_is_better=True), means),
    ]
    made = dict.fromkeys(f"{fit['commit']}, {fit['day']}, {fit['machine']}" for fit in own)
    note = f"Commit, day, machine: {'; '.join(made)}."
    return table_of(f"Mean PSNR of validation frames, dB; {limits}", columns, [note])


#: What writes each block, by the first word of its name; further words are arguments.
BLOCKS: Mapping[str, Callable[..., str]] = {
    "headline": _headline,
    "field": _field,
    "ratios": _ratios,
    "stages": _stages,
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
    blocks: dict[str, str] = {}
    made: dict[Path, str | Callable[[], bytes]] = {}
    for page in pages_of(root):
        text = page.read_text("utf-8")
        names = [found[1] for found in _BLOCK.finditer(text)]
        for name in names:
            kind, *words = name.split()
            if kind not in BLOCKS:
                remedy = f"Known: {', '.join(BLOCKS)}."
                problem = f"{kind!r} is not a block of results"
                raise UsageError(problem, where=page, field="results", remedy=remedy)
            blocks[name] = blocks.get(name) or BLOCKS[kind](sources, *words)
        if names:
            made[page] = _BLOCK.sub(lambda found: _filled(found[1], blocks), text)
    return made | sources.pictures


def _filled(name: str, blocks: Mapping[str, str]) -> str:
    return f"<!-- results: {name} -->\n{blocks[name]}\n<!-- end -->"


def write_pages(root: Path) -> list[Path]:
    """Write blocks and pictures that differ; pictures of other numbers are removed."""
    made, written = make_pages(root), []
    for file, content in made.items():
        data = content.encode() if isinstance(content, str) else content()
        if not file.is_file() or file.read_bytes() != data:
            written.append(atomic_write(file, data, overwrite=True))
    for old in (root / PICTURES).glob("*.svg"):
        if old not in made:
            old.unlink()
    return written


def find_faults(root: Path) -> list[str]:
    """Return what is wrong with results in pages, a line each; none where all is well.

    A block must be what its source says, and its pictures must be there. A decibel outside of
    the blocks of a page for users must stand in the study that its paragraph leads to, or be listed
    for the page in `TYPED`: as a definition, or as one that no file says yet. A page that another
    program writes as a whole must have the digest that it left (`with_digest`).
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
        key, place = _key(page), page.relative_to(root)
        if program := typed["generated"].get(key):
            if page.read_text("utf-8") != with_digest(page.read_text("utf-8")):
                faults.append(f"{place}: is not as {program} wrote it")
            continue
        if page.parent == studies:
            continue
        known = {*typed["definitions"].get(key, ()), *typed["unsourced"].get(key, ())}
        for line, number in _without_source(page.read_text("utf-8"), studies):
            if number not in known:
                faults.append(f"{place}:{line}: {number!r} has no source")
    return faults


def with_digest(text: str) -> str:
    """Return a page with the digest of its text in a comment at the end, in place of an old one."""
    text = _DIGEST.sub("", text).rstrip()
    return f"{text}\n\n<!-- digest: {sha256_json(text)} -->\n"


def _key(page: Path) -> str:
    """How a page is called in `TYPED`, wherever it lies below `docs`."""
    return f"{page.parent.name}/README.md" if page.match("baselines/*/README.md") else page.name


def _without_source(text: str, studies: Path) -> Iterator[tuple[int, str]]:
    """Line and text of decibels outside of blocks that no linked study has."""
    text = _BLOCK.sub(lambda found: "\n" * found[0].count("\n"), text)
    line = 1
    for paragraph in re.split(r"(\n\s*\n)", text):
        linked = [studies / name for name in _STUDY.findall(paragraph)]
        known = " ".join(" ".join(f.read_text("utf-8") for f in linked if f.is_file()).split())
        for found in _DECIBELS.finditer(paragraph):
            number = " ".join(found[0].split())
            if not re.search(rf"(?<![\d.]){re.escape(number)}", known):
                yield line + paragraph[: found.start()].count("\n"), number
        line += paragraph.count("\n")
