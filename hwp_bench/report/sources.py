"""The inputs of reports: results with their folders, grouped by their data, and what they left."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import ascii_uppercase
from typing import Annotated

import numpy as np
from msgspec import Meta

from hwp_bench.analysis.pairing import same_but_seed
from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadResult, HwpError
from hwp_bench.base.files import cache_root, inside, read_json, sha256_json
from hwp_bench.base.records import parse_record
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.folder import digest_at
from hwp_bench.capture.schema import CaptureInfo, frame_name
from hwp_bench.results import CaptureResult, Results, results_among
from hwp_bench.results.schema import MAX_FRAMES
from hwp_bench.results.store import read_unchanged
from hwp_bench.suites.suite import lost_clips

#: Largest file of temporal weights that is read, bytes.
MAX_WEIGHT_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True)
class ResultsSource:
    """One evaluation and where it lies."""

    #: The evaluation.
    results: Results
    #: Its folder, with `captures/ID/`; None where only the result itself is at hand.
    folder: Path | None

    def on(self, digest: str) -> list[CaptureResult]:
        """Return what it holds on the capture of a digest."""
        return [item for item in self.results.captures if item.digest == digest]

    def place(self, capture: str, *parts: str) -> Path | None:
        """Return a path inside the folder of a capture; None where the folder is not known."""
        if self.folder is None:
            return None
        return inside(self.folder, os.path.join("captures", capture, *parts))


@dataclass(frozen=True)
class TemporalWeights:
    """The weight that a method gave to each frame: how perturbed it takes the frame to be."""

    #: Indices of training frames.
    frames: Annotated[list[Annotated[int, Meta(lt=MAX_FRAMES)]], Meta(max_length=MAX_FRAMES)]
    #: One weight a frame, at least 0 once read.
    weights: Annotated[list[Annotated[float, Meta(ge=-1e6, le=1e6)]], Meta(max_length=MAX_FRAMES)]


def read_sources(
    paths: Iterable[str | os.PathLike[str]], *, repeats: bool = True
) -> list[ResultsSource]:
    """Read every evaluation that some paths stand for, in order."""
    sources = [ResultsSource(read_unchanged(file), file.parent) for file in results_among(paths)]
    if repeats:
        return sources
    first: dict[str, ResultsSource] = {}
    for source in sources:
        result = source.results
        known = sha256_json([same_but_seed(result), result.seed, data_key(result)])
        kept = first.setdefault(known, source)
        if kept is not source:
            notice(f"left out: {source.folder} repeats {kept.folder} (same method, settings, seed)")
    return list(first.values())


def source_folders(sources: Iterable[ResultsSource]) -> list[Path]:
    """Return where results lie, as inputs that no output may be."""
    return [source.folder for source in sources if source.folder is not None]


def stored_predictions(source: ResultsSource, item: CaptureResult) -> dict[int, Path]:
    """The predictions of the frames that were scored, by frame; empty where none are kept."""
    folder = source.place(item.id, "predictions")
    if folder is None:
        return {}
    sound = [frame.frame for frame in item.frames if frame.failure is None]
    files = {frame: folder / frame_name(frame) for frame in sound}
    return {frame: f for frame, f in files.items() if f.is_file() and not f.is_symlink()}


def temporal_weights(source: ResultsSource, capture: str) -> dict[str, TemporalWeights]:
    """Return the temporal weights that a method left, by side (`right`, `left`, or empty).

    What is returned is their magnitude: a weight times a learned bias is the same with both signs
    turned, so that the sign says nothing of how perturbed a frame is.
    """
    folder = source.place(capture, "diagnostics")
    found = {}
    for side in ("", "right", "left"):
        path = folder / f"{side}{'-' if side else ''}temporal.json" if folder else None
        if path is None or not path.is_file():
            continue
        value = read_json(path, max_bytes=MAX_WEIGHT_BYTES)
        item = parse_record(TemporalWeights, value, where=os.fspath(path))
        if len(item.frames) != len(item.weights) or not item.frames:
            raise BadResult("must hold one weight a frame", where=path, field="weights")
        if min(item.frames) < 0:
            raise BadResult("must not be below 0", where=path, field="frames")
        order = np.argsort(item.frames, kind="stable")
        found[side] = TemporalWeights(
            [item.frames[i] for i in order], [abs(item.weights[i]) for i in order]
        )
    return found


def sound_temporal_weights(source: ResultsSource, capture: str) -> dict[str, TemporalWeights]:
    """Return the temporal weights as `temporal_weights`; none, and said so, where they are damaged.

    A method writes them as it likes: they must not keep a table or a report from being made.
    """
    try:
        return temporal_weights(source, capture)
    except HwpError as error:
        notice(f"left out: {error}")
        return {}


def mean_temporal_weight(source: ResultsSource, capture: str) -> float | None:
    """Return the mean temporal weight over sides and frames, or None where none was left."""
    found = sound_temporal_weights(source, capture).values()
    return float(np.mean([np.mean(item.weights) for item in found])) if found else None


def rank_with_severity(
    source: ResultsSource, capture: str, info: CaptureInfo | None
) -> float | None:
    """Return how temporal weights rank with severity, the mean over sides that say it, or None.

    See `CaptureInfo.rank_with_severity`.
    """
    if info is None:
        return None
    sides = sound_temporal_weights(source, capture).values()
    ranks = [info.rank_with_severity(item.frames, item.weights) for item in sides]
    known = [rank for rank in ranks if rank is not None]
    return float(np.mean(known)) if known else None


def find_captures(
    results: Iterable[Results], folders: Sequence[str | os.PathLike[str]] = ()
) -> dict[str, CaptureInfo]:
    """Find what the evaluated captures say of themselves; nothing is rendered for it."""
    return {digest: info for digest, (info, _) in _located(results, folders).items()}


def open_captures_of(
    results: Iterable[Results], folders: Sequence[str | os.PathLike[str]] = ()
) -> dict[str, Capture]:
    """Open the evaluated captures that `find_captures` finds, by digest."""
    found = _located(results, folders)
    return {digest: open_capture(place) for digest, (_, place) in found.items()}


def _located(
    results: Iterable[Results], folders: Sequence[str | os.PathLike[str]]
) -> dict[str, tuple[CaptureInfo, Path]]:
    """The descriptions and folders of the captures, by digest."""
    digests = {c.digest: c.id for result in results for c in result.captures}
    given = [Path(folder) for folder in folders]
    places = list(given)
    caches = [cache_root() / kind / "captures" for kind in ("sim", "real")]
    for identifier in sorted(set(digests.values())):
        # A name from outside matches itself and nothing else.
        name = glob.escape(identifier.replace("/", "_"))
        places += [place for cache in caches for place in sorted(cache.glob(f"{name}-*"))]
    found = {}
    for place in places:
        path = place / "capture.json"
        try:
            info = CaptureInfo.from_json(read_json(path), where=os.fspath(path))
        except HwpError:
            if place in given:
                raise
            continue
        digest = digest_at(place, info)
        if digest in digests:
            found[digest] = (info, place)
        elif place in given:
            notice(f"left out: {place} is not a capture of these results")
    return found


def mean_severity(
    info: CaptureInfo, test: Iterable[int], *, perturbed_only: bool = False
) -> dict[str, float]:
    """Return the mean severity of each declared perturbation over the frames to learn from."""
    hidden = set(test)
    found = {}
    for name, values in info.perturbations.items():
        if values is None:
            continue
        seen = [value for frame, value in enumerate(values) if frame not in hidden]
        chosen = [value for value in seen if value or not perturbed_only]
        found[name] = sum(chosen) / len(chosen) if chosen else 0.0
    return found


#: Heading of the column that says which data a row is of.
HEADING = "Data"


@dataclass(frozen=True)
class DataGroup:
    """Results on the same captures, splits, test frames and masks, in the same protocols."""

    #: `A`, `B`, ... in the order of the results; empty where there is one group only.
    label: str
    #: What the group is of, in words.
    text: str
    #: The results.
    sources: tuple[ResultsSource, ...]


def data_groups(sources: Sequence[ResultsSource], *, oracles: bool = False) -> list[DataGroup]:
    """Return results by data, in the order of their first result."""
    found: dict[str, list[ResultsSource]] = {}
    for source in sources:
        found.setdefault(data_key(source.results, oracles=oracles), []).append(source)
    # `A` to `Z`, then `A1`, `B1`, ...
    letters = [f"{ascii_uppercase[k % 26]}{k // 26 or ''}" for k in range(len(found))]
    return [
        DataGroup(label if len(found) > 1 else "", _text(group[0].results), tuple(group))
        for label, group in zip(letters, found.values(), strict=True)
    ]


def data_key(results: Results, *, oracles: bool = False) -> str:
    """Return a digest of the data of a result: captures, splits, test frames, masks, protocols."""
    captures = sorted(
        (c.id, c.digest, c.split_digest, [frame.frame for frame in c.frames], c.exact_masks)
        for c in results.captures
    )
    return sha256_json([captures, results.protocols, None if oracles else results.frames])


def _text(results: Results) -> str:
    frames = sum(len(capture.frames) for capture in results.captures)
    count = len(results.captures)
    headline = max((name for name in results.protocols if name.startswith("hwp-")), default="")
    protocol = sha256_json(results.protocols)[:8]
    parts = [
        f"{results.suite}, {count} capture{'' if count == 1 else 's'}, {frames} test frames",
        *lost_clips(results),
        f"protocol {headline or 'not said'} ({protocol})",
    ]
    estimated = sum(not capture.exact_masks for capture in results.captures)
    if estimated:
        all_ = "" if estimated == count else f" in {estimated} captures"
        parts.append(f"scored on estimated masks{all_}")
    if results.frames != "perturbed":
        parts.append(f"{results.frames} training frames")
    return "; ".join(parts)


def stacked(groups: Sequence[DataGroup], tables: Sequence[Table]) -> Table:
    """Put the tables of several groups under one another; rows are ranked within their group."""
    if len(tables) == 1:
        return tables[0]
    columns = _joined([table.columns for table in tables])
    rows: list[tuple[Cell, ...]] = []
    breaks, unranked = [], set()
    for group, table in zip(groups, tables, strict=True):
        start = len(rows)
        breaks += [start, *(start + place for place in table.breaks)]
        unranked |= {start + place for place in table.unranked}
        # A table that ranks nothing keeps its rows out of the ranks.
        unranked |= set() if table.ranked else set(range(start, start + len(table.rows)))
        for row in table.rows:
            cells = {(c.group, c.title): cell for c, cell in zip(table.columns, row, strict=True)}
            rows.append((group.label, *(cells.get((c.group, c.title)) for c in columns)))
    notes = ["Results are on different data: only rows of the same data are ranked together."]
    notes += [f"{HEADING} {group.label}: {group.text}." for group in groups]
    notes += _importer_notes(groups)
    owners: dict[str, list[str]] = {}
    for group, table in zip(groups, tables, strict=True):
        for note in table.notes:
            owners.setdefault(note, []).append(group.label)
    for note, labels in owners.items():
        notes.append(note if len(labels) == len(groups) else f"{', '.join(labels)}: {note}")
    return Table(
        tables[0].caption,
        (Column(HEADING), *columns),
        tuple(rows),
        tuple(notes),
        breaks=tuple(breaks[1:]),
        unranked=frozenset(unranked),
    )


def _importer_notes(groups: Sequence[DataGroup]) -> list[str]:
    """Return a warning for captures of one name that different importers made."""
    makers: dict[str, dict[str, None]] = {}
    for group in groups:
        for source in group.sources:
            for capture in source.results.captures:
                made_by = capture.made_by or "not stated"
                makers.setdefault(capture.id, {})[made_by] = None
    return [
        f"{name} was made by different importers ({', '.join(found)}): its scores do not compare."
        for name, found in makers.items()
        if len(found) > 1
    ]


def _joined(every: Iterable[Iterable[Column]]) -> list[Column]:
    """Return the columns of several tables, those of a group next to each other."""
    found: dict[tuple[str, str], Column] = {}
    for columns in every:
        for column in columns:
            found.setdefault((column.group, column.title), column)
    # Groups in the order of their first column; a column without a group is one by itself.
    groups: dict[object, list[Column]] = {}
    for key, column in found.items():
        groups.setdefault(column.group or key, []).append(column)
    return [column for own in groups.values() for column in own]
