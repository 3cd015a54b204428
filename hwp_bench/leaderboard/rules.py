"""The rules of the leaderboard: which entries fit, share a table, carry which name, and are sound.

An entry has no pixels, so `hwp-bench dev leaderboard confirm` compares its scores. All else
that moves a number, a label or a rank is bound here: to the suite, to the key that the evaluation
left, or to other fields.
"""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadResult, HwpError, UsageError
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.packages import data_folder
from hwp_bench.base.records import Digest, Line, parse_record, without_schema
from hwp_bench.evaluation.capture_evaluation import RESULT, key_of
from hwp_bench.evaluation.verify import Discrepancy, copy_differences, digest_differences
from hwp_bench.leaderboard.entries import LEVELS, Check, Contest, Entry, make_entry, read_entries
from hwp_bench.leaderboard.suite_data import CaptureData, known_data, on_current_data, suite_origins
from hwp_bench.methods.manifest import MethodManifest, shipped_methods
from hwp_bench.metrics import HWP_V1, METRICS, PROTOCOLS, metric_names
from hwp_bench.metrics.score import aggregate
from hwp_bench.results import Results, read_results
from hwp_bench.results.schema import (
    MAX_BYTES,
    UNDECLARED,
    CaptureResult,
    TrainingData,
    score_rows,
    without_places,
)
from hwp_bench.suites.suite import find_missing, find_wrong_labels, suite_scenes
from hwp_bench.taxonomy import SUITES as ALL_SUITES

#: Suites whose captures are the same everywhere, in the order of the board: first the one that
#: nothing was tuned on. `wild-dev` is for tuning.
SUITES = ("wild-test", *(name for name in ALL_SUITES if not name.startswith("wild-")))
#: Metrics that every frame of an entry has.
HEADLINE = ("psnr", "ssim", "oriented_distance")


def check_entries(entries: Iterable[Entry]) -> list[Entry]:
    """Check that entries are fit to be ranked against each other; returns them."""
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
    order = sorted(found, key=lambda key: (SUITES.index(key[0]), key[1] != HWP_V1.name, key[1]))
    return {key: found[key] for key in order}


def current(entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries that are not withdrawn and that no other one takes the place of."""
    standing = [entry for entry in entries if not entry.withdrawal("entry")]
    replaced = {
        former.name
        for entry in standing
        for former in history(entry, entries)
        if takes_over(entry, former)
    }
    return [entry for entry in standing if entry.name not in replaced]


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
    """Return what identifies a method on the board: its name and its submitter.

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
    """Refuse an entry that lacks a part of its suite."""
    if problems := find_missing(entry.results):
        raise BadResult(
            "; ".join(problems),
            where=entry.name,
            field="captures",
            remedy=f"Evaluate the whole suite: `--suite {entry.results.suite}`.",
        )


def check_current(entry: Entry) -> None:
    """Refuse an entry of other protocols than this version's."""
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
    if shared := results.method.training.shared(suite_scenes(results.suite)):
        raise UsageError(
            f"is of a method that was trained on {', '.join(shared)}, on which it is scored",
            where=entry.name,
            field="method.training",
            remedy="Train without the suite's scenes; `wild-dev` and your own scenes are free.",
        )
    if UNDECLARED in results.method.training.private:
        raise UsageError(
            "does not say what its method was trained on",
            where=entry.name,
            field="method.training",
            remedy="Write a method directory whose method.toml says it, and evaluate that.",
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
    whole = {entry.name: not find_missing(entry.results) for entry in entries}
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
    """Check that every revision is of an entry that it can revise, and the only one of it."""
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
    """Check that every entry and check of an earlier state is still there, byte by byte."""
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


#: Version of the file.
SCHEMA = "hwp-leaderboard-names/1"
#: Its name, next to the folder of entries.
NAME = "names.json"
# Signs that look like others, and Greek and Cyrillic letters that look like Latin ones: capitals
# before the case is folded, since a capital nu looks like an N and a small one like a v.
_ALIKE = str.maketrans({"0": "o", "1": "l", "i": "l", "|": "l", "5": "s"})
_CAPITALS = str.maketrans(
    "\u0391\u0392\u0395\u0396\u0397\u0399\u039a\u039c\u039d\u039f\u03a1\u03a4\u03a5\u03a7"
    "\u0410\u0412\u0415\u041a\u041c\u041d\u041e\u0420\u0421\u0422\u0425\u0405\u0406\u0408",
    "ABEZHIKMNOPTYXABEKMHOPCTXSIJ",
)
_SMALL = str.maketrans(
    "\u03b1\u03b9\u03ba\u03bd\u03bf\u03c1\u03c5\u0251\u0261\u0131"
    "\u0430\u0435\u043e\u0440\u0441\u0443\u0445\u0455\u0456\u0458\u04bb\u0501\u051b\u051d\u0578",
    "aikvopuagiaeopcyxsijhdqwn",
)


@dataclass(frozen=True)
class Names:
    """Entries that may carry the names of methods that ship."""

    #: Their digests by the name of the method, sorted.
    entries: dict[Line, Annotated[list[Digest], Meta(max_length=10_000)]]


def read_names(folder: Path) -> frozenset[str]:
    """Return the digests listed for a folder of entries: there, and where the toolkit is."""
    found: set[str] = set()
    for file in {folder.parent / NAME, data_folder("leaderboard") / NAME}:
        if file.is_file():
            found |= {digest for own in _read(file).entries.values() for digest in own}
    return frozenset(found)


def register(folder: Path, entries: Iterable[Entry]) -> list[Entry]:
    """List the entries under names of methods that ship; returns those that were not listed.

    For the maintainers of a board, who know where these entries come from.
    """
    known = read_names(folder)
    added = [e for e in entries if e.digest not in known and _taken(e) is not None]
    if added:
        file = folder.parent / NAME
        listed = _read(file).entries if file.is_file() else {}
        for entry in added:
            name = _taken(entry) or ""
            listed[name] = sorted({*listed.get(name, []), entry.digest})
        write_json(file, {"schema": SCHEMA, **asdict(Names(dict(sorted(listed.items()))))})
    return added


def check_names(entries: Iterable[Entry], listed: frozenset[str]) -> None:
    """Refuse an entry under the name or title of a method that ships, unless it is listed."""
    for entry in entries:
        name = _taken(entry)
        method = entry.results.method
        declared = _declared().get(method.digest, method.training)
        if declared != method.training:
            raise UsageError(
                f"says that the training data are {method.training.text}; the method.toml of these "
                f"files says {declared.text}",
                where=entry.name,
                field="method.training",
            )
        if name is not None and entry.digest not in listed:
            raise UsageError(
                f"carries the name of {name}, a method that ships with the toolkit",
                where=entry.name,
                field="method.name",
                remedy="Give the method a name and title of its own in its method.toml. Rows of "
                "methods that ship come from maintainers (`hwp-bench dev leaderboard register`).",
            )


@cache
def shipped_manifests() -> list[MethodManifest]:
    """The methods that ship, read once."""
    return shipped_methods()


@cache
def _declared() -> dict[str, TrainingData]:
    """The training data that methods that ship declare, by their digests."""
    return {manifest.digest: manifest.training for manifest in shipped_manifests()}


@cache
def _shipped() -> dict[str, str]:
    """Names of methods by their names and titles, as these look."""
    found: dict[str, str] = {}
    for manifest in shipped_manifests():
        found |= {_look(manifest.name): manifest.name, _look(manifest.title): manifest.name}
    return found


def is_shipped(name: str) -> bool:
    """Whether a method of that name ships with the toolkit."""
    return name in _shipped().values()


def _taken(entry: Entry) -> str | None:
    """Return the method that ships whose name or title an entry seems to carry, or None."""
    method = entry.results.method
    if is_shipped(method.name):
        return method.name
    return _shipped().get(_look(method.name)) or _shipped().get(_look(method.title))


def _look(text: str) -> str:
    """Return a text as it looks at a glance: without case, accents, spaces and signs."""
    plain = unicodedata.normalize("NFKD", text).translate(_CAPITALS).casefold().translate(_SMALL)
    return "".join(c for c in plain if c.isalnum()).translate(_ALIKE)


def _read(file: Path) -> Names:
    value = without_schema(read_json(file), SCHEMA, where=file, error=BadResult)
    return parse_record(Names, value, where=file)


# --- whether an entry is as it says

#: By how much a fit may last longer than the process around it, s: two clocks.
_CLOCKS = 1e-3
#: By how much the clocks of two machines may differ.
_SKEW = timedelta(minutes=10)
#: By how much sums in another order may differ.
_ROUNDING = 1e-9


def check_bound(entry: Entry) -> None:
    """Refuse an entry whose labels, data, keys, penalties or checks do not go together.

    Entries of other protocols than this version's are of other versions of the suites, of which
    nothing is known here; they pass.
    """
    if entry.protocol != HWP_V1.name:
        return
    if problems := find_wrong_labels(entry.results):
        raise _wrong(entry, "captures", "; ".join(problems))
    known = known_data().suites.get(entry.results.suite, {})
    origins = suite_origins(entry.results.suite)
    for capture in entry.results.captures:
        if origins and capture.origin != origins.get(capture.id):
            problem = "is not what this version imports the suite's clip from"
            raise _wrong(entry, f"{capture.id}.origin", problem)
        _check_data(entry, capture, known.get(capture.id))
        _check_frames(entry, capture)
        _check_times(entry, capture)
    for check in entry.checks:
        _check_verdict(entry, check)
        _check_overruling(entry, check)
    for contest in entry.contests:
        check_contest(entry, contest)


def repeats(first: Results, second: Results) -> bool:
    """Return whether two runs are of the same method in the same state on the same data."""
    if first.started == second.started:
        return False
    one, other = (
        (
            replace(item.method, settings=without_places(item.method.settings)),
            item.suite,
            item.seed,
            item.budget,
            item.frames,
            sorted((c.id, c.digest, c.split_digest, c.exposed or "") for c in item.captures),
        )
        for item in (on_current_data(first), on_current_data(second))
    )
    return one == other


def check_contest(entry: Entry, contest: Contest) -> None:
    """Refuse a contest whose run is not of the entry or unsound, or a withdrawal of no contest."""
    if contest.results is None:
        if not any(other.results and other.rerun == contest.rerun for other in entry.contests):
            problem = f"withdraws {contest.rerun[:8]}, which does not contest the entry"
            raise _wrong(entry, "contests", problem)
        return
    if not repeats(entry.results, contest.results):
        raise BadResult(
            "is contested by a run of another method, settings, seed, budget or data, or by itself",
            where=entry.name,
            field=f"contests, {contest.rerun[:8]}",
            remedy="Run the method of the entry again with its settings, seed and budget.",
        )
    rerun = replace(make_entry(contest.results), name=f"{entry.name}, contest {contest.rerun[:8]}")
    check_entries([rerun])
    check_complete(rerun)
    check_bound(rerun)


def check_dates(entry: Entry, now: datetime | None = None) -> None:
    """Refuse an entry or a check of it that is dated after now, or a check before its entry."""
    latest = (now or datetime.now(UTC)) + _SKEW
    started = _moment(entry, "started", entry.results.started)
    if started > latest:
        raise _wrong(entry, "started", f"is {entry.results.started}, which is not yet")
    for check in entry.additions:
        _check_date(entry, check, started, latest)


def _check_date(entry: Entry, check: Check | Contest, started: datetime, latest: datetime) -> None:
    date = _moment(entry, f"checks, {check.kind} {check.digest[:8]}", check.date)
    if date > latest or date < started:
        problem = "is not yet" if date > latest else f"is before {entry.results.started}, its run"
        raise BadResult(
            f"is dated {check.date}, which {problem}",
            where=entry.name,
            field=f"checks, {check.kind} {check.digest[:8]}",
            remedy="Look at the clock of the machine, and make the file again.",
        )


def _moment(entry: Entry, field: str, text: str) -> datetime:
    """Read a moment; its form is right, but there may be no such day."""
    try:
        return datetime.fromisoformat(text)
    except ValueError as error:
        raise _wrong(entry, field, f"is {text}, which is not a moment") from error


def _check_overruling(entry: Entry, check: Check) -> None:
    known = {other.digest for other in entry.checks}
    if unknown := [digest for digest in check.overrules if digest not in known]:
        field = f"checks, {check.kind} of {check.date}"
        raise _wrong(entry, field, f"overrules {unknown[0][:8]}, which is not a check of the entry")


def without_false_checks(entry: Entry, now: datetime | None = None) -> Entry:
    """Return the entry without checks and contests that are false; each is reported."""
    kept: list[Check | Contest] = []
    for check in entry.additions:
        try:
            if isinstance(check, Contest):
                check_dates(replace(entry, checks=(), contests=(check,)), now)
                check_contest(entry, check)
            else:
                check_dates(replace(entry, checks=(check,), contests=()), now)
                if entry.protocol == HWP_V1.name:
                    _check_verdict(entry, check)
                    _check_overruling(entry, check)
        except HwpError as error:
            if error.field == "started":
                raise
            left_out(error)
        else:
            kept.append(check)
    sound = replace(
        entry,
        checks=tuple(check for check in kept if isinstance(check, Check)),
        contests=tuple(check for check in kept if isinstance(check, Contest)),
    )
    # What answers a false file is false with it.
    return sound if len(kept) == len(entry.additions) else without_false_checks(sound, now)


def _check_data(entry: Entry, capture: CaptureResult, data: CaptureData | None) -> None:
    version = data.version(capture.digest) if data is not None else None
    known = data is not None and (version is not None or data.current is not None)
    if known and version is None:
        raise _wrong(entry, f"{capture.id}.digest", "is not the data of the suite")
    same = [one for one in data.versions if one.digest == capture.digest] if data else []
    clips = {None, *(one.free_view for one in same)}
    if capture.free_view is not None:
        clips = {capture.free_view.digest}
    elif not known and capture.isolation is None:
        # Predictions that came as files, without the clip: its digest is in the key alone.
        return
    if capture.key not in {key_of(entry.results, capture, clip) for clip in clips}:
        raise _wrong(
            entry,
            f"{capture.id}.key",
            "is not the key of its method, settings, seed, budget, frames and protocols",
        )


def _check_frames(entry: Entry, capture: CaptureResult) -> None:
    penalties = {facts.name: facts.penalty for facts in METRICS}
    scored = 0
    metrics = set(entry.results.metrics)
    if capture.free_view is not None and not capture.free_view.frames:
        raise _wrong(entry, f"{capture.id}.free_view", "has no frame")
    for frame in [*capture.frames, *(capture.free_view.frames if capture.free_view else [])]:
        place = f"{capture.id}, frame {frame.frame}"
        if metrics != frame.scores.keys():
            odd = ", ".join(sorted(metrics ^ frame.scores.keys()))
            raise _wrong(entry, place, f"has other metrics than the first frame ({odd})")
        if absent := sorted(set(metric_names()) - frame.scores.keys()):
            raise _wrong(entry, place, f"lacks the metrics {', '.join(absent)}")
        scored += frame.failure is None
        if frame.failure is None:
            continue
        if any(value != penalties.get(name, value) for name, value in frame.scores.items()):
            raise _wrong(entry, place, "failed, and has other scores than the penalties")
    if capture.failure is not None and scored:
        raise _wrong(entry, f"{capture.id}.failure", f"says that all failed; {scored} have scores")


def _check_times(entry: Entry, capture: CaptureResult) -> None:
    fit, wall = capture.fit_seconds, capture.wall_seconds
    if fit is not None and fit > wall + _CLOCKS:
        problem = f"is {fit:g} s, longer than the {wall:g} s of the process"
        raise _wrong(entry, f"{capture.id}.fit_seconds", problem)


def _check_verdict(entry: Entry, check: Check) -> None:
    """A check's verdict follows from its numbers and those of the entry."""
    captures = entry.results.captures
    most = sum(
        len(c.frames) + (len(c.free_view.frames) if c.free_view is not None else 0)
        for c in captures
    )
    field = f"checks, {check.kind} of {check.date}"
    if check.frames > most or check.same_predictions > len(captures):
        raise _wrong(entry, field, f"is of more frames or captures than the entry has ({most})")
    if check.kind == "rescored":
        same = not check.differences
    else:
        apart = abs(check.scores["psnr"] - entry.results.scores["psnr"])
        same = apart <= check.tolerance + _ROUNDING
    if same != (check.verdict == "reproduces"):
        raise _wrong(entry, field, f"says {check.verdict!r}, and its numbers say otherwise")


def _wrong(entry: Entry, field: str, problem: str) -> BadResult:
    return BadResult(
        problem,
        where=entry.name,
        field=field,
        remedy="Evaluate again, and submit the results as they are written.",
    )


def check_source(file: Path) -> None:
    """Refuse a result file that was changed by hand, before an entry is made of it."""
    read_results(file)  # another file has no digests to compare
    value = read_json(file, max_bytes=MAX_BYTES)
    found: list[Discrepancy] = [
        *copy_differences(file.parent, value, RESULT),
        *digest_differences(value),
    ]
    if found:
        first = found[0]
        raise BadResult(
            f"was changed by hand: the file says {first.recorded}, found was {first.found}",
            where=file,
            field=", ".join(text for text in (first.capture, first.what) if text),
            remedy="Evaluate again; `hwp-bench verify` shows all that differs.",
        )


def sound_entries(folder: Path) -> list[Entry]:
    """Read the sound entries of a folder; others are left out and named.

    A false entry blocks no other one: it is left out alone, with those that revise it.
    `hwp-bench leaderboard check` refuses it.
    """
    entries: list[Entry] = []
    listed = read_names(folder)
    for entry in read_entries(folder, left_out):
        try:
            check_entries([_alone(entry)])
            check_names([entry], listed)
            check_dates(replace(entry, checks=(), contests=()))
            entry = without_false_checks(entry)
            check_bound(entry)
        except HwpError as error:
            left_out(error)
            continue
        entries.append(entry)
    for rows in tables_of(entries).values():
        for entry, other in off_the_data(rows):
            notice(f"left out: {entry.name} is on other data than {other}")
            entries = [kept for kept in entries if kept is not entry]
    return _without_false_revisions(entries)


def left_out(error: HwpError) -> None:
    """Say that a file is left out, and why."""
    notice(f"left out: {error}")


def _alone(entry: Entry) -> Entry:
    """The entry as one that revises nothing."""
    return replace(entry, submission=replace(entry.submission, revises=None, reason=""))


def _without_false_revisions(entries: Sequence[Entry]) -> list[Entry]:
    kept: list[Entry] = []
    waiting = list(entries)
    while waiting:
        names = {entry.name for entry in kept}
        ready = [e for e in waiting if e.submission.revises in (None, *names)]
        if not ready:
            break
        for entry in ready:
            waiting.remove(entry)
            try:
                check_revisions([*kept, entry])
            except UsageError as error:
                revised = [e for e in kept if e.name == entry.submission.revises]
                if revised and source_of(revised[0]) != source_of(entry):
                    # Somebody else's row: it stands for itself.
                    notice(f"{error.where}: {error.problem}: it is a row of its own")
                    kept.append(_alone(entry))
                else:
                    left_out(error)
            else:
                kept.append(entry)
    for entry in waiting:
        notice(f"left out: {entry.name} revises {entry.submission.revises}, which is not sound")
    order = {entry.name: place for place, entry in enumerate(entries)}
    return sorted(kept, key=lambda entry: order[entry.name])
