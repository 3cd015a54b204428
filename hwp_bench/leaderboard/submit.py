"""Makes entries of results with the folder of a pull request, and checks of entries."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, cast

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.files import atomic_folder, files_digest, sha256_of
from hwp_bench.base.packages import __version__
from hwp_bench.evaluation.scoring import predictions_digest, read_predictions
from hwp_bench.evaluation.verify import verify_results
from hwp_bench.leaderboard.entries import (
    Check,
    Contest,
    Entry,
    Submission,
    digest,
    make_entry,
    refuse_installed,
    write_entry,
)
from hwp_bench.leaderboard.rules import (
    HEADLINE,
    check_bound,
    check_complete,
    check_contest,
    check_current,
    check_dates,
    check_entries,
    check_names,
    current,
    register,
    repeats,
    sound_entries,
)
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import Results, read_results
from hwp_bench.results.schema import environment
from hwp_bench.suites.suite import suite

#: Where entries lie in the repository, and in a submission.
PLACE = "leaderboard/entries"
#: Name of the text of the pull request.
TEXT = "PULL_REQUEST.md"


def add_entries(folder: Path, results: Iterable[Results]) -> list[Path]:
    """Write entries of results without a submission; returns their files.

    Results that have an entry stay as they are. Entries under the name of a method that ships are
    registered. Nothing is written where one of them cannot stand.
    """
    known = sound_entries(folder)
    made = [make_entry(one) for one in results]
    for entry in made:
        check_current(entry)
    check_entries([*known, *(one for one in made if one.name not in {e.name for e in known})])
    for entry in made:
        check_dates(entry)
        check_bound(entry)
    files = [write_entry(folder, entry) for entry in made]
    register(folder, made)
    return files


def submit(
    folder: Path,
    sources: Sequence[ResultsSource],
    existing: Sequence[Entry],
    submission: Submission,
    avatars: Path | None = None,
) -> list[tuple[Entry, int]]:
    """Write a folder with everything that a pull request needs.

    Returns:
        Its entries, each with the number of captures whose predictions lie next to the results.
    """
    refuse_installed(folder)
    if submission.revises is not None and len(sources) != 1:
        raise UsageError("a revision is of one result", field="--revises")
    made: list[tuple[Entry, int]] = []
    for source in sources:
        added = submission
        if avatars is not None:
            captures = [capture.id for capture in source.results.captures]
            added = replace(submission, avatars=avatar_digests(avatars, captures))
        entry = make_entry(source.results, added)
        check_current(entry)
        others = [*existing, *(one for one, _ in made)]
        # The rules of single entries come first: only a known suite can be complete.
        check_entries([*others, entry])
        check_names([entry], frozenset())
        check_dates(entry)
        check_complete(entry)
        check_bound(entry)
        if entry.name in {other.name for other in others}:
            raise UsageError("is on the leaderboard already", where=entry.name)
        made.append((entry, _check_predictions(source)))
    with atomic_folder(folder) as temporary:
        for entry, _ in made:
            write_entry(temporary / PLACE, entry)
        (temporary / TEXT).write_text(pull_request_text(made), encoding="utf-8")
    return made


def _check_predictions(source: ResultsSource) -> int:
    """Return the number of captures whose predictions are there and are those of the result."""
    sizes = {item.id: item.size for item in suite(source.results.suite)}
    found = 0
    for capture in source.results.captures:
        place = source.place(capture.id, "predictions")
        if place is None or not place.is_dir():
            continue
        size = sizes[capture.id]
        frames = [frame.frame for frame in capture.frames]
        if predictions_digest(read_predictions(place, frames, (size, size))) != (
            capture.predictions_digest
        ):
            raise BadResult(
                "are not the predictions that the result was scored from",
                where=place,
                remedy="Evaluate again; `hwp-bench verify` shows what differs.",
            )
        found += 1
    return found


def avatar_digests(folder: Path, captures: Sequence[str]) -> dict[str, str]:
    """Return the SHA-256 of the avatar of each capture: of a file, or of a folder's files."""
    found = {}
    for name in captures:
        places = [place for place in sorted(folder.glob("*")) if _is_avatar_of(place, name)]
        if len(places) != 1:
            many = ", ".join(place.name for place in places)
            raise BadResult(
                f"holds {many}, which are two" if places else "holds no avatar of the capture",
                where=folder,
                field=name,
                remedy="Give one file or folder for each capture, named by its id.",
            )
        (place,) = places
        files = [p for p in place.rglob("*") if p.is_file() and not p.is_symlink()]
        found[name] = files_digest(place, files) if place.is_dir() else sha256_of(place)
    return found


def _is_avatar_of(place: Path, name: str) -> bool:
    return not place.is_symlink() and (place.name == name or place.stem == name)


def pull_request_text(made: Iterable[tuple[Entry, int]]) -> str:
    """Return the text of the pull request, Markdown: the rows, their digests, how to check."""
    lines = ["# New leaderboard rows", ""]
    for entry, there in made:
        results, added = entry.results, entry.submission
        scores, count = results.scores, len(results.captures)
        lines += [
            f"## {_plain(results.method.title)} on {results.suite}",
            "",
            f"- entry: `{PLACE}/{entry.name}.json`, digest `{entry.digest}`",
            f"- protocol {entry.protocol}, seed {results.seed}, {count} captures, complete",
            f"- PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f}, oriented distance "
            f"{scores['oriented_distance']:.4f} (macro means)",
            f"- level: {entry.level}; predictions at hand of {there} of {count} captures",
        ]
        if added.by:
            lines.append(f"- submitted by {_plain(added.by)}")
        if added.revises:
            lines.append(f"- revises `{_plain(added.revises)}`: {_plain(added.reason)}")
        lines += [f"- {name}: <{address}>" for name, address in sorted(added.links.items())]
        lines += ["", "| capture | predictions | avatar |", "| --- | --- | --- |"]
        lines += [
            f"| {_plain(c.id)} | `{c.predictions_digest}` | {avatar} |"
            for c in results.captures
            for avatar in [f"`{added.avatars[c.id]}`" if added.avatars.get(c.id) else "–"]
        ]
        lines.append("")
    lines += [
        "## How to check",
        "",
        "```sh",
        f"hwp-bench leaderboard check --entries {PLACE} --against BASE/{PLACE}",
        f"hwp-bench dev leaderboard confirm RESULTS --entries {PLACE} --checked-by NAME",
        "```",
    ]
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    """Return a text without the characters that mean something in Markdown or HTML."""
    return "".join(char for char in text if char not in "`|<>[]*_\\") or "–"


#: Largest difference of the macro mean of PSNR with which a second run reproduces a row, dB.
TOLERANCE = 0.1


def confirm(
    entry: Entry,
    file: Path,
    captures: Sequence[Path],
    *,
    by: str,
    tolerance: float = TOLERANCE,
    overrules: Sequence[str] = (),
    reason: str = "",
) -> Check:
    """Check the entry that a result is of, or is a second run of (`entry_of`).

    The result is verified first (`hwp-bench verify`). Where it is the entry's own, the check is
    of the kind `rescored`, and reproduces where nothing differs. Where it is another run of the
    same method, settings, seed, budget and data, the kind is `re-run`.
    """
    results = read_results(file)
    overruled = _overruled(entry, overrules)
    own = entry.results == results
    found = verify_results(file, captures)
    differences = len(found.discrepancies)
    absent = [one for one in found.discrepancies if one.not_here]
    if own and absent:
        # Nothing was found out about the row, and a check cannot be taken back.
        raise BadResult(
            f"cannot be scored again here: {absent[0].what} {absent[0].recorded}, "
            f"found {absent[0].found}",
            where=file,
            field=absent[0].capture,
            remedy="Give its predictions, and its captures (--capture); or run the method again.",
        )
    if differences and not own:
        first = found.discrepancies[0]
        raise BadResult(
            f"is not as it says ({differences} differences, {first.capture} {first.what})",
            where=file,
            remedy="See all of them with `hwp-bench verify`, and run the method again.",
        )
    before, after = entry.results.scores, results.scores
    same = not differences if own else abs(after["psnr"] - before["psnr"]) <= tolerance
    here = environment()
    theirs = {capture.id: capture.predictions_digest for capture in entry.results.captures}
    return Check(
        entry=entry.name,
        entry_digest=entry.digest,
        kind="rescored" if own else "re-run",
        verdict="reproduces" if same else "differs",
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        by=by,
        toolkit=__version__,
        code=here["code"],
        machine=f"{here['processor']}, {here['cores']} cores, {here['system']}",
        frames=found.frames,
        cross_checked=found.cross_checked,
        differences=differences,
        rerun=None if own else digest(results),
        scores={} if own else {metric: after[metric] for metric in HEADLINE},
        same_predictions=0
        if own
        else sum(theirs[item.id] == item.predictions_digest for item in results.captures),
        tolerance=0.0 if own else tolerance,
        overrules=overruled,
        reason=reason,
    )


def _overruled(entry: Entry, named: Sequence[str]) -> list[str]:
    """Return the digests of the checks that are named by their first digits."""
    found = []
    for start in named:
        fitting = [check.digest for check in entry.checks if check.digest.startswith(start)]
        if len(start) < 8 or len(fitting) != 1:
            known = ", ".join(check.digest[:8] for check in entry.checks) or "none"
            raise UsageError(
                f"{start!r} is not one check of {entry.name}",
                field="--overrules",
                remedy=f"Its checks: {known}.",
            )
        found += fitting
    return found


def entry_of(entries: Sequence[Entry], results: Results, name: str | None) -> Entry:
    """Return the entry of that name, or the only one that the results are of or repeat."""
    fitting = [entry for entry in entries if entry.results == results]
    fitting = fitting or [entry for entry in entries if repeats(entry.results, results)]
    if name is None and len(fitting) > 1:
        fitting = [entry for entry in current(entries) if entry in fitting]
    if name is not None:
        fitting = [entry for entry in fitting if entry.name == name]
    if len(fitting) == 1:
        return fitting[0]
    named = ", ".join(entry.name for entry in fitting)
    raise UsageError(
        f"several entries fit: {named}" if fitting else "no entry is of this result or run",
        field="--entry",
        remedy="Name one of them with --entry."
        if fitting
        else "A second run has the entry's method, settings, preset, seed, budget and captures.",
    )


def contest(
    entry: Entry, rerun: Path | str, *, by: str, reason: str, withdraws: str = ""
) -> Contest:
    """Return what puts a re-evaluation next to an entry, or what withdraws one of the two.

    Args:
        entry: the entry.
        rerun: the re-evaluation's file; for a withdrawal the first digits of its digest.
        by: who contests or withdraws.
        reason: why.
        withdraws: `entry` or `rerun` for a withdrawal.

    Raises:
        BadResult: the re-evaluation is not of the entry's method, state and data, or not sound.
        UsageError: no contest of the entry has this digest.
    """
    results, full = None, str(rerun)
    if withdraws:
        known = {one.rerun for one in entry.contests if one.results}
        fitting = [one for one in known if one.startswith(full)]
        if len(full) < 8 or len(fitting) != 1:
            raise UsageError(
                f"{full!r} is not one re-evaluation of {entry.name}",
                field="RERUN",
                remedy=f"Contested by: {', '.join(sorted(one[:8] for one in known)) or 'none'}.",
            )
        (full,) = fitting
    else:
        results = read_results(rerun)
        full = digest(results)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    kind = cast('Literal["entry", "rerun"] | None', withdraws or None)
    found = Contest(entry.name, entry.digest, full, now, by, reason, results, kind)
    check_contest(entry, found)
    return found
