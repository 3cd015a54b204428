"""Whether an entry is as it says: labels, data, keys, penalties and checks, as far as it can tell.

An entry has no pixels, so that its scores are compared by `hwp-bench leaderboard confirm`. All else
that moves a number, a label or a rank is bound here: to the suite, to the key that the evaluation
left, or to other fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadResult, HwpError, UsageError
from hwp_bench.base.files import read_json
from hwp_bench.evaluation.capture_evaluation import RESULT, key_of
from hwp_bench.evaluation.sentences import find_wrong_labels
from hwp_bench.evaluation.verify import Discrepancy, copy_differences, digest_differences
from hwp_bench.leaderboard.entries import Check, Entry, entry_files, read_checks, read_entry
from hwp_bench.leaderboard.rules import (
    check_entries,
    check_names,
    check_revisions,
    off_the_data,
    read_names,
    source_of,
    tables_of,
)
from hwp_bench.leaderboard.suite_data import CaptureData, known_data
from hwp_bench.metrics import HWP_V1, metric_names, penalty
from hwp_bench.results import CaptureResult
from hwp_bench.results.schema import MAX_BYTES

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
    for capture in entry.results.captures:
        _check_data(entry, capture, known.get(capture.id))
        _check_frames(entry, capture)
        _check_times(entry, capture)
    for check in entry.checks:
        _check_verdict(entry, check)
        _check_overruling(entry, check)


def check_dates(entry: Entry, now: datetime | None = None) -> None:
    """Refuse an entry or a check of it that is dated after now, or a check before its entry."""
    latest = (now or datetime.now(UTC)) + _SKEW
    started = datetime.fromisoformat(entry.results.started)
    if started.tzinfo is None:
        started = started.replace(tzinfo=UTC)
    if started > latest:
        raise _wrong(entry, "started", f"is {entry.results.started}, which is not yet")
    for check in entry.checks:
        _check_date(entry, check, started, latest)


def _check_date(entry: Entry, check: Check, started: datetime, latest: datetime) -> None:
    date = datetime.fromisoformat(check.date)
    if date > latest or date < started:
        problem = "is not yet" if date > latest else f"is before {entry.results.started}, its run"
        raise BadResult(
            f"is dated {check.date}, which {problem}",
            where=entry.name,
            field=f"checks, {check.kind} {check.digest[:8]}",
            remedy="Look at the clock of the machine; check again with "
            "`hwp-bench leaderboard confirm`.",
        )


def _check_overruling(entry: Entry, check: Check) -> None:
    known = {other.digest for other in entry.checks}
    if unknown := [digest for digest in check.overrules if digest not in known]:
        field = f"checks, {check.kind} of {check.date}"
        raise _wrong(entry, field, f"overrules {unknown[0][:8]}, which is not a check of the entry")


def without_false_checks(entry: Entry, now: datetime | None = None) -> Entry:
    """Return the entry without checks that are false; each of them is said."""
    kept = []
    for check in entry.checks:
        alone = replace(entry, checks=(check,))
        try:
            check_dates(alone, now)
            if entry.protocol == HWP_V1.name:
                _check_verdict(entry, check)
                _check_overruling(entry, check)
        except BadResult as error:
            if error.field == "started":
                raise
            notice(f"left out: {error}")
        else:
            kept.append(check)
    return replace(entry, checks=tuple(kept))


def _check_data(entry: Entry, capture: CaptureResult, data: CaptureData | None) -> None:
    version = data.version(capture.digest) if data is not None else None
    known = data is not None and (version is not None or data.current is not None)
    if known and version is None:
        raise _wrong(entry, f"{capture.id}.digest", "is not the data of the suite")
    clips = {version.free_view if version else None, None}
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
    penalties = penalty()
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
        if any(frame.scores[name] != value for name, value in penalties.items()):
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
    """Read the entries of a folder that are sound; what is not is left out and said.

    A false entry blocks no other one: it is left out alone, with those that revise it.
    `hwp-bench leaderboard check` refuses it.
    """
    entries: list[Entry] = []
    listed = read_names(folder)
    for entry in readable_entries(folder):
        try:
            check_entries([_alone(entry)])
            check_names([entry], listed)
            check_dates(replace(entry, checks=()))
            entry = without_false_checks(entry)
            check_bound(entry)
        except HwpError as error:
            notice(f"left out: {error}")
            continue
        entries.append(entry)
    for rows in tables_of(entries).values():
        for entry, other in off_the_data(rows):
            notice(f"left out: {entry.name} is on other data than {other}")
            entries = [kept for kept in entries if kept is not entry]
    return _without_false_revisions(entries)


def readable_entries(folder: Path) -> list[Entry]:
    """Read the entries of a folder with their checks; files that are damaged are left out and said.

    A check of an entry or content that is not there is left out, too.
    """
    entries: list[Entry] = []
    checks = []
    for check, fault in read_checks(folder):
        if fault is not None:
            notice(f"left out: {fault}")
        elif check is not None:
            checks.append(check)
    for file in entry_files(folder):
        try:
            entries.append(read_entry(file, checks))
        except HwpError as error:
            notice(f"left out: {error}")
    return entries


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
                    notice(f"left out: {error}")
            else:
                kept.append(entry)
    for entry in waiting:
        notice(f"left out: {entry.name} revises {entry.submission.revises}, which is not sound")
    order = {entry.name: place for place, entry in enumerate(entries)}
    return sorted(kept, key=lambda entry: order[entry.name])
