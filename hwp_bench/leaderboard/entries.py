"""Entries of the leaderboard: whole results with a digest, one JSON file each, and their checks."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from msgspec import Meta

from hwp_bench.base.errors import BadResult, HwpError, UsageError
from hwp_bench.base.files import atomic_write, read_json, sha256_json
from hwp_bench.base.packages import PACKAGES
from hwp_bench.base.records import Count, Digest, Line, Moment, number, parse_record, without_schema
from hwp_bench.results import Results
from hwp_bench.results.schema import MAX_CAPTURES, ScoreTable, check_scores

#: Version of the entry files. `submission` was added within it and may be missing.
ENTRY_SCHEMA = "hwp-leaderboard-entry/1"
#: Version of the check files.
CHECK_SCHEMA = "hwp-leaderboard-check/1"
#: Version of the files of contests.
CONTEST_SCHEMA = "hwp-leaderboard-contest/1"
#: How far a row was checked, the least first.
LEVELS = ("self-reported", "rescored", "re-run")
#: What a reproducibility badge can say, and what it means.
BADGES = {
    "not tried": "nobody has checked this row yet",
    "scores hold": "the predictions have these scores; the method was not run again",
    "reproduces": "a second run of the method had the same score within the tolerance",
    "differs": "a check found other numbers than the row has",
    "disputed": "its checks contradict each other; the one that differs counts",
    "contested": "a re-evaluation stands against it; the lower score counts until that is settled",
}
#: What a link of a submission can lead to.
LINKS = ("code", "paper", "predictions", "avatars")

T = TypeVar("T")


@dataclass(frozen=True)
class Submission:
    """A submitter and what was added to the results: corrections, links, digests of avatars."""

    #: Who stands for the row.
    by: Line = ""
    #: Name of the entry that this one corrects; None for a first entry.
    revises: Line | None = None
    #: Why it was corrected; empty for a first entry.
    reason: Line = ""
    #: Addresses by what they lead to (`LINKS`); each begins with `https://`.
    links: dict[Line, Line] = field(default_factory=dict)
    #: SHA-256 of the fitted avatar of each capture, by capture id.
    avatars: Annotated[dict[Line, Digest], Meta(max_length=MAX_CAPTURES)] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        if (self.revises is None) != (not self.reason):
            raise UsageError("a revision needs a reason, and a reason a revision", field="reason")
        for name, address in self.links.items():
            if name not in LINKS:
                known = f"Known: {', '.join(LINKS)}."
                raise UsageError(f"{name!r} is not a kind of link", field="links", remedy=known)
            if not address.startswith("https://") or any(c in address for c in " \"'<>\\"):
                raise UsageError("is not an https:// address", field=f"links.{name}")


@dataclass(frozen=True)
class Check:
    """One check of an entry, made by `hwp-bench dev leaderboard confirm`."""

    #: Name of the entry.
    entry: Line
    #: Digest in the entry's file: a check is of one content only.
    entry_digest: Digest
    #: `rescored`: its predictions were scored again. `re-run`: the method was run again.
    kind: Literal["rescored", "re-run"]
    #: Whether the numbers of the entry were found again.
    verdict: Literal["reproduces", "differs"]
    #: When, ISO 8601, UTC.
    date: Moment
    #: Who checked.
    by: Line
    #: Version of the toolkit that checked.
    toolkit: Line
    #: Digest of its modules.
    code: Line
    #: Processor, cores and system that it ran on.
    machine: Line
    #: Frames whose scores were computed again from predictions.
    frames: Count
    #: Of them, frames whose PSNR and SSIM scikit-image computed too.
    cross_checked: Count
    #: Parts of the checked result that were not as it says.
    differences: Count
    #: Digest of the second run's results; None for `rescored`.
    rerun: Digest | None = None
    #: Macro means that the second run had, by metric.
    scores: ScoreTable = field(default_factory=dict)
    #: Captures of the second run whose predictions are those of the entry, pixel by pixel.
    same_predictions: Count = 0
    #: Largest difference of the macro mean of PSNR that still reproduces, dB.
    tolerance: float = number(0.0, 0.0, 100.0)
    #: Digests of checks of the same entry that this one takes out of force.
    overrules: Annotated[list[Digest], Meta(max_length=100)] = field(default_factory=list)
    #: Why it does; empty where it overrules none.
    reason: Line = ""

    def __post_init__(self) -> None:
        check_scores(self.scores)
        if self.cross_checked > self.frames:
            raise UsageError("is more than the frames", field="cross_checked")
        if self.kind == "rescored" and (self.rerun is not None or self.scores):
            raise UsageError("belongs to a second run, which this is not", field="rerun")
        if self.kind == "re-run" and (self.rerun is None or "psnr" not in self.scores):
            raise UsageError("must have the digest and PSNR of the second run", field="rerun")
        if bool(self.overrules) != bool(self.reason):
            raise UsageError("who overrules a check gives a reason", field="reason")

    @property
    def content(self) -> dict[str, Any]:
        """Its fields as its file holds them; those that are of no use in it are left out."""
        fields = asdict(self)
        return fields if self.overrules else _without(fields, "overrules", "reason")

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of its content, by which another check overrules it."""
        return sha256_json(self.content)


@dataclass(frozen=True)
class Contest:
    """A re-evaluation that somebody puts next to an entry, or the withdrawal of one of the two."""

    #: Name of the entry, and the digest in its file.
    entry: Line
    entry_digest: Digest
    #: Digest of the re-evaluation's results.
    rerun: Digest
    #: When, ISO 8601, UTC.
    date: Moment
    #: Who contests or withdraws, and why.
    by: Annotated[Line, Meta(min_length=1)]
    reason: Annotated[Line, Meta(min_length=1)]
    #: The re-evaluation; None in a withdrawal.
    results: Results | None = None
    #: What is withdrawn, which settles the contest; None in the contest itself.
    withdraws: Literal["entry", "rerun"] | None = None

    def __post_init__(self) -> None:
        if (self.results is None) == (self.withdraws is None):
            raise UsageError("must have exactly one of results and withdraws", field="results")

    @property
    def content(self) -> dict[str, Any]:
        """Its fields as its file holds them."""
        return asdict(self)

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of its content."""
        return sha256_json(self.content)

    @property
    def kind(self) -> str:
        """Kind of record, from which its file is named."""
        return "contest" if self.withdraws is None else "withdrawal"


def _without(fields: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if name not in names}


def in_force(checks: Iterable[Check]) -> list[Check]:
    """Return the checks of an entry that no other one overrules, in the order given.

    A check that is itself overruled overrules none. Dates decide nothing: they can be forged.
    """
    waiting = list(checks)
    everything = list(waiting)
    kept: dict[str, bool] = {}
    while waiting:
        ready = []
        for check in waiting:
            above = [other.digest for other in everything if check.digest in other.overrules]
            if all(digest in kept for digest in above):
                ready.append((check, not any(kept[digest] for digest in above)))
        # A digest cannot hold itself, so that there is always one that nothing undecided overrules.
        for check, stays in ready:
            kept[check.digest] = stays
            waiting.remove(check)
        if not ready:
            break
    return [check for check in everything if kept.get(check.digest, False)]


def level(checks: Iterable[Check]) -> str:
    """Return how far a row was checked: the highest of `LEVELS` that no check in force denies."""
    found = in_force(checks)
    denied = {check.kind for check in found if check.verdict == "differs"}
    held = {check.kind for check in found} - denied
    return max(["self-reported", *held], key=LEVELS.index)


def badge(checks: Iterable[Check]) -> str:
    """Return the reproducibility badge of a row, one of `BADGES`."""
    found = in_force(checks)
    denied = {check.kind for check in found if check.verdict == "differs"}
    if any(check.kind in denied and check.verdict == "reproduces" for check in found):
        return "disputed"
    if denied:
        return "differs"
    return {"self-reported": "not tried", "rescored": "scores hold", "re-run": "reproduces"}[
        level(found)
    ]


#: Largest entry or contest that is read, bytes: the full suite takes about 1 MB.
MAX_ENTRY_BYTES = 16 * 1024 * 1024
#: Folders of checks and of contests, inside that of the entries.
CHECKS, CONTESTS = "checks", "contests"


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
    #: Re-evaluations that stand next to it, and withdrawals.
    contests: tuple[Contest, ...] = ()

    @property
    def level(self) -> str:
        """How far it was checked, one of `LEVELS`."""
        return level(self.checks)

    @property
    def badge(self) -> str:
        """Its reproducibility badge, one of `BADGES`."""
        return "contested" if self.open_contests else badge(self.checks)

    @property
    def additions(self) -> list[Check | Contest]:
        """Its checks and contests."""
        return [*self.checks, *self.contests]

    def withdrawal(self, kind: str, rerun: str | None = None) -> Contest | None:
        """Return what withdraws the entry, or one of the re-evaluations that contest it."""
        fitting = [one for one in self.contests if rerun in (None, one.rerun)]
        return next((one for one in fitting if one.withdraws == kind), None)

    @property
    def open_contests(self) -> list[Contest]:
        """The contests that are not settled: neither the entry nor the other run is withdrawn."""
        if self.withdrawal("entry"):
            return []
        return [one for one in self.contests if one.results and not self.settled(one)]

    def settled(self, contest: Contest) -> Contest | None:
        """Return what settled a contest of the entry; None where it is open."""
        return self.withdrawal("entry") or self.withdrawal("rerun", contest.rerun)

    @property
    def counted(self) -> Results:
        """The results that the board shows: while it is contested, those with the lower PSNR."""
        others = [one.results for one in self.open_contests if one.results]
        if not others:
            return self.results
        return min([self.results, *others], key=lambda results: results.scores["psnr"])

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


@dataclass(frozen=True)
class _ContestFile:
    """The content of a contest's file, next to its `schema`."""

    digest: str
    contest: Contest


def entry_name(results: Results, content: str | None = None) -> str:
    """Return the name of an entry: method, suite, budget, seed, and part of its digest."""
    parts = [results.method.name, results.suite]
    if results.budget.get("seconds"):
        parts.append(f"{results.budget['seconds']:.15g}s")
    if results.budget.get("steps"):
        parts.append(f"{results.budget['steps']:.15g}steps")
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
    """Write an entry that `make_entry` made; returns its file."""
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
    """Refuse to write into a package that is installed."""
    place = folder.resolve()
    packages = {"site-packages", "dist-packages"} & set(place.parts)
    if packages or place.is_relative_to(PACKAGES / "hwp_bench"):
        raise UsageError(
            "belongs to an installed package, which is never changed",
            where=folder,
            remedy="Make a submission: `hwp-bench leaderboard submit RESULTS -o FOLDER`.",
        )


def read_entries(folder: Path, on_fault: Callable[[HwpError], None] | None = None) -> list[Entry]:
    """Read every entry of a folder with its checks and contests, by name.

    A damaged file, and a check or contest of an entry or content that is not there, is refused.
    With `on_fault` they are left out, and it is called with what is wrong with a file.
    """
    checks = _read_all(sorted((folder / CHECKS).glob("*.json")), _read_check, on_fault)
    contests = _read_all(sorted((folder / CONTESTS).glob("*.json")), _read_contest, on_fault)
    entries = _read_all(
        entry_files(folder), lambda file: read_entry(file, checks, contests), on_fault
    )
    known = {(entry.name, entry.digest) for entry in entries}
    others: list[Check | Contest] = [*checks, *contests]
    for other in others if on_fault is None else ():
        if (other.entry, other.entry_digest) not in known:
            raise BadResult(
                f"is of {other.entry} with digest {other.entry_digest[:8]}, which is not there",
                where=_file_next_to(folder, other),
                field="entry",
            )
    return entries


def _read_all(
    files: Iterable[Path], read: Callable[[Path], T], on_fault: Callable[[HwpError], None] | None
) -> list[T]:
    found = []
    for file in files:
        try:
            found.append(read(file))
        except HwpError as error:
            if on_fault is None:
                raise
            on_fault(error)
    return found


def entry_files(folder: Path) -> list[Path]:
    """Return the files of the entries of a folder, by name; none where there is no folder."""
    return sorted(folder.glob("*.json")) if folder.is_dir() else []


def read_entry(file: Path, checks: Sequence[Check], contests: Sequence[Contest] = ()) -> Entry:
    """Read one entry; its checks and contests are those among the given ones that name it."""
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
    own, against = (
        tuple(one for one in found if (one.entry, one.entry_digest) == (file.stem, content))
        for found in (checks, contests)
    )
    added = entry.submission or Submission()
    return Entry(file.stem, results, added, content, own, against)  # type: ignore[arg-type]


def _file_next_to(folder: Path, other: Check | Contest) -> Path:
    """Return the file of a check or contest: its entry, its kind, and part of its digest."""
    place = CHECKS if isinstance(other, Check) else CONTESTS
    return folder / place / f"{other.entry}.{other.kind}-{other.digest[:8]}.json"


def write_check(folder: Path, other: Check | Contest) -> Path:
    """Write a check or contest below a folder of entries; returns its file."""
    refuse_installed(folder)
    name, schema = "check", CHECK_SCHEMA
    if isinstance(other, Contest):
        name, schema = "contest", CONTEST_SCHEMA
    value = {"schema": schema, "digest": other.digest, name: other.content}
    text = json.dumps(value, indent=None if name == "contest" else 1, allow_nan=False)
    return atomic_write(_file_next_to(folder, other), text + "\n")


def _read_check(file: Path) -> Check:
    value = without_schema(read_json(file), CHECK_SCHEMA, where=file)
    content = parse_record(_CheckFile, value, where=file)
    if content.digest != sha256_json(value["check"]):
        raise _changed(file, "check", "Check again with `hwp-bench dev leaderboard confirm`.")
    return content.check


def _read_contest(file: Path) -> Contest:
    value = without_schema(read_json(file, max_bytes=MAX_ENTRY_BYTES), CONTEST_SCHEMA, where=file)
    content = parse_record(_ContestFile, value, where=file)
    given = value["contest"]
    if content.digest != sha256_json(given):
        raise _changed(file, "contest", "Contest again with `hwp-bench dev leaderboard contest`.")
    if given.get("results") is not None and sha256_json(given["results"]) != given["rerun"]:
        raise BadResult("is not the digest of its results", where=file, field="contest.rerun")
    return content.contest


def _changed(file: Path, what: str, remedy: str) -> BadResult:
    return BadResult(
        f"is not the digest of the content: the {what} was changed by hand",
        where=file,
        field="digest",
        remedy=remedy,
    )
