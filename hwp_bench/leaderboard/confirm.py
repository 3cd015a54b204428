"""Checks of an entry: its predictions are scored again, or a second run is held against it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.packages import __version__
from hwp_bench.evaluation.verify import verify_results
from hwp_bench.leaderboard.entries import Entry, digest
from hwp_bench.leaderboard.records import Check
from hwp_bench.leaderboard.rules import HEADLINE, current
from hwp_bench.leaderboard.suite_data import on_current_data
from hwp_bench.results import Results, read_results
from hwp_bench.results.environment import environment

#: Largest difference of the macro mean of PSNR with which a second run reproduces a row, dB.
TOLERANCE = 0.1


def confirm(
    entries: Sequence[Entry],
    file: Path,
    captures: Sequence[Path],
    *,
    by: str,
    name: str | None = None,
    tolerance: float = TOLERANCE,
    overrules: Sequence[str] = (),
    reason: str = "",
) -> Check:
    """Check the entry that a result is of, or is a second run of.

    The result is verified first (`hwp-bench verify`). Where it is the entry's own, the check is
    of the kind `rescored`, and reproduces where nothing differs. Where it is another run of the
    same method, settings, seed, budget and data, the kind is `re-run`.

    Args:
        entries: the leaderboard's entries.
        file: the result file, with its predictions next to it.
        captures: folders of its captures.
        by: who checks.
        name: name of the entry; None takes the only one that fits.
        tolerance: largest difference in dB of a second run, 0 to 100.
        overrules: digests, or at least their first eight digits, of checks of the entry that do
            not count from now on.
        reason: why they do not.

    Raises:
        UsageError: no entry fits, several do, the tolerance is out of range, or there is no such
            check to overrule.
        BadResult: a second run is itself not as it says, so that it cannot speak for the entry.
    """
    if not 0 <= tolerance <= 100:
        raise UsageError(f"{tolerance} is not between 0 and 100 dB", field="--tolerance")
    results = read_results(file)
    entry = entry_of(entries, results, name)
    overruled = _overruled(entry, overrules)
    own = entry.results == results
    found = verify_results(file, captures)
    differences = len(found.discrepancies)
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
    """Return the entry of that name, or the only one that the results are of or repeat.

    Raises:
        UsageError: no entry fits, or several do.
    """
    fitting = [entry for entry in entries if entry.results == results]
    fitting = fitting or [entry for entry in entries if _repeats(entry.results, results)]
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


def _repeats(entry: Results, results: Results) -> bool:
    """Return whether two runs are of the same method in the same state on the same data."""
    if entry.started == results.started:
        return False
    first, second = (
        (
            item.method,
            item.suite,
            item.seed,
            item.budget,
            item.frames,
            sorted((c.id, c.digest, c.split_digest) for c in item.captures),
        )
        for item in (on_current_data(entry), on_current_data(results))
    )
    return first == second
