"""The rules of the leaderboard: what makes an entry fit, and which entries share a table."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.evaluation.completeness import missing
from hwp_bench.leaderboard.entries import Entry
from hwp_bench.leaderboard.names import is_shipped
from hwp_bench.leaderboard.records import LEVELS
from hwp_bench.leaderboard.suite_data import on_current_data
from hwp_bench.metrics import HWP_V1, PROTOCOLS
from hwp_bench.metrics.score import aggregate
from hwp_bench.results.schema import score_rows
from hwp_bench.taxonomy import SUITES as ALL_SUITES

#: Suites whose captures are the same everywhere. `wild-dev` is for tuning.
SUITES = tuple(name for name in ALL_SUITES if name != "wild-dev")
#: Metrics that every frame of an entry has.
HEADLINE = ("psnr", "ssim", "oriented_distance")


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
    check_revisions(listed)
    return listed


def tables_of(entries: Iterable[Entry]) -> dict[tuple[str, str], list[Entry]]:
    """Return the entries by suite and protocol; no table holds two versions of a protocol."""
    found: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries:
        found.setdefault(entry.table, []).append(entry)
    order = sorted(found, key=lambda key: (ALL_SUITES.index(key[0]), key[1] != HWP_V1.name, key[1]))
    return {key: found[key] for key in order}


def current(entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries that no other one takes the place of."""
    replaced = {
        former.name
        for entry in entries
        for former in history(entry, entries)
        if takes_over(entry, former)
    }
    return [entry for entry in entries if entry.name not in replaced]


def takes_over(revision: Entry, revised: Entry) -> bool:
    """Whether a revision takes the place of an entry that it, or what it revises, names.

    It must be of the same method, submitter and suite, and checked at least as far: a correction
    of a row that was checked waits for a check of its own.
    """
    return (
        source_of(revision) == source_of(revised)
        and revision.results.suite == revised.results.suite
        and LEVELS.index(revision.level) >= LEVELS.index(revised.level)
    )


def source_of(entry: Entry) -> tuple[str, str]:
    """Return what makes a method of the board: its name, and who stands for it.

    The names of methods that ship are the toolkit's own, whoever ran them: see
    `names.check_names`.
    """
    name = entry.results.method.name
    return name, "" if is_shipped(name) else entry.submission.by


def history(entry: Entry, entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries that an entry revises, the latest first, without the entry itself."""
    named = {other.name: other for other in entries}
    found: list[Entry] = []
    step = entry.submission.revises
    while step in named and named[step] not in found:
        found.append(named[step])
        step = named[step].submission.revises
    return found


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
    for entry, first in off_the_data(entries):
        raise UsageError(
            f"is on other captures, splits or test frames than {first}",
            where=entry.name,
            field="captures",
            remedy="Evaluate both with the same version of the suite.",
        )


def off_the_data(entries: Sequence[Entry]) -> list[tuple[Entry, str]]:
    """Return the entries of one table that are not on its data, each with one that is.

    The data of a capture are those of the entries that were checked furthest; among these, of a
    whole suite; among these, of the most entries; among these, of the first. So an entry that
    nobody checked does not push out those that stand.
    """
    whole = {entry.name: not missing(entry.results) for entry in entries}
    votes: dict[str, dict[tuple[Any, ...], list[Entry]]] = {}
    for entry in entries:
        for c in on_current_data(entry.results).captures:
            data = (c.digest, c.split_digest, tuple(frame.frame for frame in c.frames))
            votes.setdefault(c.id, {}).setdefault(data, []).append(entry)
    found: dict[str, tuple[Entry, str]] = {}
    for groups in votes.values():
        chosen = max(
            groups.values(),
            key=lambda group: (
                max(LEVELS.index(entry.level) for entry in group),
                any(whole[entry.name] for entry in group),
                len(group),
            ),
        )
        for group in groups.values():
            for entry in group if group is not chosen else ():
                found.setdefault(entry.name, (entry, chosen[0].name))
    return list(found.values())


def check_revisions(entries: Sequence[Entry]) -> None:
    """Check that every revision is of an entry that it can revise, and the only one of it.

    Raises:
        UsageError: one is not; it is named.
    """
    named = {entry.name: entry for entry in entries}
    revised: dict[str, str] = {}
    for entry in entries:
        name = entry.submission.revises
        if name is None:
            continue
        problem = None
        remedy = "Name the latest entry of the method with --revises."
        if name not in named:
            problem = f"revises {name}, which is not there"
        elif named[name].results.method.name != entry.results.method.name or (
            named[name].results.suite != entry.results.suite
        ):
            problem = f"revises {name}, which is of another method or suite"
        elif source_of(named[name]) != source_of(entry):
            problem = f"revises {name}, which somebody else stands for"
            remedy = "Submit it as an entry of its own, without --revises."
        elif name in revised:
            problem = f"revises {name}, which {revised[name]} revises already"
        if problem:
            raise UsageError(
                problem,
                where=entry.name,
                field="revises",
                remedy=remedy,
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
