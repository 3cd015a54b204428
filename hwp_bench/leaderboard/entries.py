"""Entries of the leaderboard: whole results with a digest, one JSON file each."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadResult, HwpError, UsageError
from hwp_bench.base.files import atomic_write, read_json, sha256_json
from hwp_bench.base.packages import PACKAGES
from hwp_bench.base.records import parse_record, without_schema
from hwp_bench.leaderboard.records import (
    CHECK_SCHEMA,
    ENTRY_SCHEMA,
    Check,
    Submission,
    badge,
    level,
)
from hwp_bench.results import Results

#: Largest entry that is read, bytes: the full suite takes about 1 MB.
MAX_ENTRY_BYTES = 16 * 1024 * 1024
#: Folder of checks, inside that of the entries.
CHECKS = "checks"


@dataclass(frozen=True)
class Entry:
    """One row of the leaderboard."""

    #: Name of its file without the ending.
    name: str
    #: The results, every frame's scores included.
    results: Results
    #: What the submitter added; nothing in the oldest entries.
    submission: Submission = field(default_factory=Submission)
    #: Digest of the file's content; empty for one that is in no file yet.
    digest: str = ""
    #: Its checks.
    checks: tuple[Check, ...] = ()

    @property
    def level(self) -> str:
        """How far it was checked, one of `records.LEVELS`."""
        return level(self.checks)

    @property
    def badge(self) -> str:
        """Its reproducibility badge, one of `records.BADGES`."""
        return badge(self.checks)

    @property
    def protocol(self) -> str:
        """Name of the protocol of its headline scores, such as `hwp-v1`; empty without one."""
        named = [name for name in self.results.protocols if name.startswith("hwp-")]
        return max(named, default="")

    @property
    def table(self) -> tuple[str, str]:
        """Suite and protocol: rows are ranked within one table and never over two."""
        return self.results.suite, self.protocol


@dataclass(frozen=True)
class _File:
    """The content of an entry's file, next to its `schema`."""

    digest: str
    results: Results
    submission: Submission | None = None


@dataclass(frozen=True)
class _CheckFile:
    """The content of a check's file, next to its `schema`."""

    digest: str
    check: Check


def entry_name(results: Results, content: str | None = None) -> str:
    """Return the name of an entry: method, suite, budget, seed, and part of its digest.

    Args:
        results: the results.
        content: the digest of the entry; None takes that of the results.
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


def make_entry(results: Results, submission: Submission | None = None) -> Entry:
    """Return the entry of some results; nothing is checked or written."""
    added = submission or Submission()
    content = _content(asdict(results), asdict(added) if added != Submission() else None)
    return Entry(entry_name(results, content), results, added, content)


def write_entry(folder: Path, entry: Entry) -> Path:
    """Write an entry that `make_entry` made; returns its file.

    Raises:
        UsageError: the folder belongs to an installed package.
    """
    refuse_installed(folder)
    value: dict[str, Any] = {"schema": ENTRY_SCHEMA, "digest": entry.digest}
    if entry.submission != Submission():
        value["submission"] = asdict(entry.submission)
    value["results"] = asdict(entry.results)
    # One line a capture keeps the file small and its changes readable.
    return atomic_write(folder / f"{entry.name}.json", _file_text(value))


def _content(results: dict[str, Any], submission: dict[str, Any] | None) -> str:
    """Return the digest of an entry: of its results alone where nothing was added to them."""
    added = {"results": results, "submission": submission}
    return sha256_json(results if submission is None else added)


def _file_text(value: dict[str, Any]) -> str:
    results = dict(value["results"])
    captures = results.pop("captures")
    head = json.dumps({**value, "results": results}, allow_nan=False)
    lines = ",\n".join(json.dumps(capture, allow_nan=False) for capture in captures)
    return f'{head[:-2]}, "captures": [\n{lines}\n]}}}}\n'


def refuse_installed(folder: Path) -> None:
    """Refuse to write into a package that is installed.

    Raises:
        UsageError: the folder lies in one.
    """
    place = folder.resolve()
    packages = {"site-packages", "dist-packages"} & set(place.parts)
    if packages or place.is_relative_to(PACKAGES / "hwp_bench"):
        raise UsageError(
            "belongs to an installed package, which is never changed",
            where=folder,
            remedy="Make a submission: `hwp-bench leaderboard submit RESULTS -o FOLDER`.",
        )


def read_entries(folder: Path) -> list[Entry]:
    """Read every entry of a folder with its checks, by name.

    Raises:
        BadInput: a file is damaged.
        BadResult: a file breaks the schema, its digest is not that of its content, or a check is
            of no entry that is there.
    """
    checks = []
    for check, fault in read_checks(folder):
        if fault is not None:
            raise fault
        if check is not None:
            checks.append(check)
    entries = [read_entry(file, checks) for file in entry_files(folder)]
    known = {(entry.name, entry.digest) for entry in entries}
    for check in checks:
        if (check.entry, check.entry_digest) not in known:
            raise BadResult(
                f"is of {check.entry} with digest {check.entry_digest[:8]}, which is not there",
                where=folder / CHECKS / f"{check_name(check)}.json",
                field="entry",
            )
    return entries


def entry_files(folder: Path) -> list[Path]:
    """Return the files of the entries of a folder, by name; none where there is no folder."""
    return sorted(folder.glob("*.json")) if folder.is_dir() else []


def read_checks(folder: Path) -> Iterator[tuple[Check | None, HwpError | None]]:
    """Read every check below a folder of entries, by name: the check, or why it cannot be read."""
    for file in sorted((folder / CHECKS).glob("*.json")):
        try:
            yield _read_check(file), None
        except HwpError as error:
            yield None, error


def read_entry(file: Path, checks: Sequence[Check]) -> Entry:
    """Read one entry.

    Args:
        file: the file.
        checks: checks of any entries.

    Raises:
        BadInput, BadResult: as `read_entries`.
    """
    value = without_schema(read_json(file, max_bytes=MAX_ENTRY_BYTES), ENTRY_SCHEMA, where=file)
    entry = parse_record(_File, value, where=file)
    results = entry.results
    # The digest is of the file's own fields: an old file lacks those that were added later.
    content = _content(value["results"], value.get("submission"))
    if entry.digest != content:
        raise BadResult(
            "is not the digest of the content: the entry was changed by hand",
            where=file,
            field="digest",
            remedy="Submit a revision: `hwp-bench leaderboard submit RESULTS --revises ENTRY`.",
        )
    if file.stem != entry_name(results, content):
        raise BadResult(f"must be called {entry_name(results, content)}.json", where=file)
    own = tuple(c for c in checks if (c.entry, c.entry_digest) == (file.stem, content))
    return Entry(file.stem, results, entry.submission or Submission(), content, own)


def check_name(check: Check) -> str:
    """Return the name of a check's file: its entry, its kind, and part of its digest."""
    return f"{check.entry}.{check.kind}-{check.digest[:8]}"


def write_check(folder: Path, check: Check) -> Path:
    """Write a check below a folder of entries; returns its file.

    Raises:
        UsageError: the folder belongs to an installed package.
    """
    refuse_installed(folder)
    value = {"digest": check.digest, "check": check.content}
    text = json.dumps({"schema": CHECK_SCHEMA, **value}, indent=1, allow_nan=False)
    return atomic_write(folder / CHECKS / f"{check_name(check)}.json", text + "\n")


def _read_check(file: Path) -> Check:
    value = without_schema(read_json(file), CHECK_SCHEMA, where=file)
    content = parse_record(_CheckFile, value, where=file)
    if content.digest != sha256_json(value["check"]):
        raise BadResult(
            "is not the digest of the content: the check was changed by hand",
            where=file,
            field="digest",
            remedy="Check again with `hwp-bench leaderboard confirm`.",
        )
    return content.check
