"""Entries of the leaderboard: whole results with a digest, one JSON file each."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.files import atomic_write, read_json, sha256_json
from hwp_bench.base.records import parse_record, without_schema
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.metrics.aggregate import aggregate
from hwp_bench.results import Results
from hwp_bench.results.schema import score_rows

#: Version of the entry files.
SCHEMA = "hwp-leaderboard-entry/1"
#: Largest entry that is read, bytes: the full suite takes about 1 MB.
MAX_ENTRY_BYTES = 16 * 1024 * 1024
#: Suites whose captures are the same everywhere.
SUITES = ("smoke", "mini", "full")


@dataclass(frozen=True)
class Entry:
    """One row of the leaderboard."""

    #: Name of its file without the ending.
    name: str
    #: The results, every frame's scores included.
    results: Results


@dataclass(frozen=True)
class _File:
    """The content of an entry's file, next to its `schema`."""

    digest: str
    results: Results


def entry_name(results: Results, content: str | None = None) -> str:
    """Return the name of an entry: method, suite, budget, seed, and part of its digest.

    Args:
        results: the results.
        content: their digest; None computes it.
    """
    parts = [results.method.name, results.suite]
    if results.budget.get("seconds"):
        parts.append(f"{results.budget['seconds']:g}s")
    if results.budget.get("steps"):
        parts.append(f"{results.budget['steps']:g}steps")
    parts += [f"seed{results.seed}", (content or digest(results))[:8]]
    return re.sub(r"[^a-z0-9.]+", "-", "-".join(parts).lower()).strip("-.")


def digest(results: Results) -> str:
    """Return the SHA-256 (hex) of a result's canonical JSON."""
    return sha256_json(asdict(results))


def add_entry(folder: Path, results: Results) -> Path:
    """Write an entry; returns its file.

    Raises:
        BadResult, UsageError: the results are not fit for the leaderboard, or do not go together
            with the entries that are there.
    """
    entry = Entry(entry_name(results), results)
    check_entries([*read_entries(folder), entry])
    value = {"schema": SCHEMA, "digest": digest(results), "results": asdict(results)}
    # One line a capture keeps the file small and its changes readable.
    return atomic_write(folder / f"{entry.name}.json", _file_text(value))


def _file_text(value: dict[str, Any]) -> str:
    results = dict(value["results"])
    captures = results.pop("captures")
    head = json.dumps({**value, "results": results}, allow_nan=False)
    lines = ",\n".join(json.dumps(capture, allow_nan=False) for capture in captures)
    return f'{head[:-2]}, "captures": [\n{lines}\n]}}}}\n'


def read_entries(folder: Path) -> list[Entry]:
    """Read every entry of a folder, by name.

    Raises:
        BadInput: a file is damaged.
        BadResult: a file breaks the schema, or its digest is not that of its content.
    """
    files = sorted(folder.glob("*.json")) if folder.is_dir() else []
    return [_read(file) for file in files]


def _read(file: Path) -> Entry:
    value = without_schema(read_json(file, max_bytes=MAX_ENTRY_BYTES), SCHEMA, where=file)
    entry = parse_record(_File, value, where=file)
    results = entry.results
    # The digest is of the file's own fields: an old file lacks those that were added later.
    content = sha256_json(value["results"])
    if entry.digest != content:
        raise BadResult(
            "is not the digest of the content: the entry was changed by hand",
            where=file,
            field="digest",
            remedy="Make it again with `hwp-bench leaderboard add RESULTS`.",
        )
    if file.stem != entry_name(results, content):
        raise BadResult(f"must be called {entry_name(results, content)}.json", where=file)
    return Entry(file.stem, results)


def check_entries(entries: Iterable[Entry]) -> list[Entry]:
    """Check that entries are fit to be ranked against each other; returns them.

    Raises:
        UsageError: an entry is of no suite, of clean frames, or of other data, splits, test
            frames or protocols than the entries of the same suite.
        BadResult: scores are missing or impossible.
    """
    listed = list(entries)
    for entry in listed:
        _check_one(entry)
    for suite in SUITES:
        _check_same([entry for entry in listed if entry.results.suite == suite])
    return listed


def _check_one(entry: Entry) -> None:
    results = entry.results
    if results.suite not in SUITES:
        raise UsageError(
            f"was made on {results.suite!r}, no suite that everybody has",
            where=entry.name,
            field="suite",
            remedy=f"The leaderboard takes results of --suite {', '.join(SUITES)}.",
        )
    if results.frames != "perturbed":
        raise UsageError(
            f"was given {results.frames} frames; the leaderboard is of perturbed ones",
            where=entry.name,
            field="frames",
        )
    current = {protocol.name: protocol.as_dict() for protocol in PROTOCOLS}
    # Written and read again, so that tuples and lists do not look different.
    if json.loads(json.dumps(current)) != json.loads(json.dumps(results.protocols)):
        raise UsageError(
            "was scored by other protocols than this version's",
            where=entry.name,
            field="protocols",
            remedy="Evaluate again with this version of the toolkit.",
        )
    for capture in results.captures:
        for frame in capture.frames:
            if not {"psnr", "ssim", "oriented_distance"} <= frame.scores.keys():
                raise BadResult("lacks a headline metric", where=entry.name, field=capture.id)
    aggregate(score_rows(results))


def _check_same(entries: Sequence[Entry]) -> None:
    for entry in entries[1:]:
        if _data(entry.results) != _data(entries[0].results):
            raise UsageError(
                f"is on other captures, splits or test frames than {entries[0].name}",
                where=entry.name,
                field="captures",
                remedy="Evaluate both with the same version of the suite.",
            )


def _data(results: Results) -> list[tuple[Any, ...]]:
    return sorted(
        (c.id, c.digest, c.split_digest, tuple(frame.frame for frame in c.frames))
        for c in results.captures
    )
