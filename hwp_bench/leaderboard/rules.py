"""The rules of the leaderboard: what makes an entry fit, and which entries share a table."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.capture.splits import split_for
from hwp_bench.leaderboard.entries import Entry, make_entry, read_entries, write_entry
from hwp_bench.metrics import HWP_V1, PROTOCOLS
from hwp_bench.metrics.aggregate import aggregate
from hwp_bench.results import Results
from hwp_bench.results.schema import score_rows
from hwp_bench.sim.produce.suites import suite
from hwp_bench.taxonomy.suites import SUITES as ALL_SUITES

#: Suites whose captures are the same everywhere. `wild-dev` is for tuning.
SUITES = tuple(name for name in ALL_SUITES if name != "wild-dev")
#: Metrics that every frame of an entry has.
HEADLINE = ("psnr", "ssim", "oriented_distance")


def add_entry(folder: Path, results: Results) -> Path:
    """Write an entry of results without a submission; returns its file.

    Raises:
        BadResult, UsageError: the results are not fit for the leaderboard, or do not go together
            with the entries that are there.
    """
    entry = make_entry(results)
    check_current(entry)
    check_entries([*read_entries(folder), entry])
    return write_entry(folder, entry)


def check_entries(entries: Iterable[Entry]) -> list[Entry]:
    """Check that entries are fit to be ranked against each other; returns them.

    Raises:
        UsageError: an entry is of no suite, of clean frames, of settings that are not its
            protocol's, or of other data, splits or test frames than the entries of the same
            suite and protocol; or a revision is of no entry that can be revised.
        BadResult: scores are missing or impossible.
    """
    listed = list(entries)
    for entry in listed:
        _check_one(entry)
    for rows in tables_of(listed).values():
        _check_same(rows)
    _check_revisions(listed)
    return listed


def tables_of(entries: Iterable[Entry]) -> dict[tuple[str, str], list[Entry]]:
    """Return the entries by suite and protocol; no table holds two versions of a protocol."""
    found: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries:
        found.setdefault(entry.table, []).append(entry)
    order = sorted(found, key=lambda key: (ALL_SUITES.index(key[0]), key[1] != HWP_V1.name, key[1]))
    return {key: found[key] for key in order}


def current(entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries that no other one revises: those that are ranked."""
    revised = {entry.submission.revises for entry in entries}
    return [entry for entry in entries if entry.name not in revised]


def history(entry: Entry, entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries that an entry revises, the latest first, without the entry itself."""
    named = {other.name: other for other in entries}
    found: list[Entry] = []
    step = entry.submission.revises
    while step in named and named[step] not in found:
        found.append(named[step])
        step = named[step].submission.revises
    return found


def missing(results: Results) -> list[str]:
    """Return what results lack of their suite, in words; empty where they are complete.

    Every capture of the suite must be there under its name, with the suite's own split and every
    test frame, whether it was predicted or failed.
    """
    problems = []
    items = {item.scene.id: item for item in suite(results.suite)}
    given = {capture.id: capture for capture in results.captures}
    if absent := sorted(items.keys() - given.keys()):
        problems.append(f"lacks {len(absent)} of {len(items)} captures: {', '.join(absent)}")
    if foreign := sorted(given.keys() - items.keys()):
        problems.append(f"has captures that are not of the suite: {', '.join(foreign)}")
    if len(given) != len(results.captures):
        problems.append("has a capture twice")
    for name in sorted(items.keys() & given.keys()):
        split = split_for(name, items[name].frame_count)
        if given[name].split_digest != split.digest:
            problems.append(f"{name}: is split otherwise than the suite")
        elif [frame.frame for frame in given[name].frames] != split.test.tolist():
            problems.append(f"{name}: lacks test frames")
    return problems


def check_complete(entry: Entry) -> None:
    """Refuse an entry that lacks a part of its suite.

    Raises:
        BadResult: captures or test frames are missing, or are not the suite's.
    """
    if problems := missing(entry.results):
        raise BadResult(
            "; ".join(problems),
            where=entry.name,
            field="captures",
            remedy=f"Evaluate the whole suite: `--suite {entry.results.suite}`.",
        )


def check_current(entry: Entry) -> None:
    """Refuse an entry of other protocols than this version's.

    Raises:
        UsageError: the settings of a protocol differ.
    """
    ours = _as_stored({protocol.name: protocol.as_dict() for protocol in PROTOCOLS})
    if ours != _as_stored(entry.results.protocols):
        raise _other_protocols(entry)


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
    # A version that this one knows has its settings; another version has a table of its own.
    stated = results.protocols.get(entry.protocol)
    if not entry.protocol or (
        entry.protocol == HWP_V1.name and _as_stored(stated) != _as_stored(HWP_V1.as_dict())
    ):
        raise _other_protocols(entry)
    for capture in results.captures:
        for frame in capture.frames:
            if not set(HEADLINE) <= frame.scores.keys():
                raise BadResult("lacks a headline metric", where=entry.name, field=capture.id)
    aggregate(score_rows(results))


def _other_protocols(entry: Entry) -> UsageError:
    return UsageError(
        "was scored by other protocols than this version's",
        where=entry.name,
        field="protocols",
        remedy="Evaluate again with this version of the toolkit.",
    )


def _as_stored(value: Any) -> Any:
    """Return a value as JSON gives it back, so that tuples and lists do not look different."""
    return json.loads(json.dumps(value))


def _check_same(entries: Sequence[Entry]) -> None:
    seen: dict[str, tuple[tuple[Any, ...], str]] = {}
    for entry in entries:
        for c in entry.results.captures:
            data = (c.digest, c.split_digest, tuple(frame.frame for frame in c.frames))
            first = seen.setdefault(c.id, (data, entry.name))
            if first[0] != data:
                raise UsageError(
                    f"is on other captures, splits or test frames than {first[1]}",
                    where=entry.name,
                    field="captures",
                    remedy="Evaluate both with the same version of the suite.",
                )


def _check_revisions(entries: Sequence[Entry]) -> None:
    named = {entry.name: entry for entry in entries}
    revised: dict[str, str] = {}
    for entry in entries:
        name = entry.submission.revises
        if name is None:
            continue
        problem = None
        if name not in named:
            problem = f"revises {name}, which is not there"
        elif named[name].results.method.name != entry.results.method.name or (
            named[name].results.suite != entry.results.suite
        ):
            problem = f"revises {name}, which is of another method or suite"
        elif name in revised:
            problem = f"revises {name}, which {revised[name]} revises already"
        if problem:
            raise UsageError(
                problem,
                where=entry.name,
                field="revises",
                remedy="Name the latest entry of the method with --revises.",
            )
        revised[name] = entry.name


def check_unchanged(folder: Path, base: Path) -> int:
    """Check that every entry and check of an earlier state is still there, byte by byte.

    Args:
        folder: the entries.
        base: the entries before, such as those of the branch that a pull request goes to.

    Returns:
        How many files are new.

    Raises:
        UsageError: the earlier folder does not exist.
        BadResult: a file was changed or removed: entries never change, a correction is a revision.
    """
    if not base.is_dir():
        raise UsageError("does not exist", where=base, field="--against")
    before, after = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*.json")}
        for root in (base, folder)
    )
    for name, content in sorted(before.items()):
        if after.get(name) != content:
            raise BadResult(
                "was changed" if name in after else "was removed",
                where=folder / name,
                remedy="Entries never change. Submit a revision: `leaderboard submit --revises`.",
            )
    return len(after.keys() - before.keys())
