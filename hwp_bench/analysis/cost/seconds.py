"""Where the seconds of whole runs go: the fit, and everything around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hwp_bench.analysis.statistics.pairing import MethodRuns
from hwp_bench.base.tables import Column, Table
from hwp_bench.results import CaptureResult

#: The parts of a run, in the order of time, with what they hold.
PARTS: Mapping[str, str] = {
    "start": "the method's process begins, imports, compiles, reads; at its end it writes",
    "fit": "the method's clock",
    "curve": "checkpoints are rendered, the method's clock stands still",
    "render": "the test frames are rendered",
    "score": "the benchmark copies the request, checks, scores, draws pictures",
}


def run_seconds(capture: CaptureResult) -> dict[str, float] | None:
    """Return the seconds of one run by part; None where they were not put on record.

    Args:
        capture: the result of the run.

    Returns:
        Keys are those of `PARTS`. What a method does not say of itself is part of its start.
    """
    if capture.job_seconds is None or not capture.wall_seconds:
        return None
    said = {
        "fit": capture.fit_seconds or 0.0,
        "curve": capture.curve_seconds or 0.0,
        "render": capture.render_seconds or 0.0,
    }
    # A method that claims more than its process took cannot make the rest negative.
    start = max(capture.wall_seconds - sum(said.values()), 0.0)
    return {"start": start, **said, "score": max(capture.job_seconds - capture.wall_seconds, 0.0)}


def seconds_table(runs: Sequence[MethodRuns]) -> Table | None:
    """Return one row a part of the runs, and their sum; None where nothing is on record."""
    every = [
        run_seconds(capture)
        for run in runs
        for result in run.seeds.values()
        for capture in result.captures
    ]
    known = [parts for parts in every if parts is not None]
    whole = sum(sum(parts.values()) for parts in known)
    if not whole:
        return None
    columns = (
        Column("Part"),
        Column("Mean of a run [s]", 2),
        Column("All runs [s]", 1),
        Column("Share [%]", 1),
        Column("What it is"),
    )
    sums = {name: sum(parts[name] for parts in known) for name in PARTS}
    rows = [
        (name, spent / len(known), spent, 100 * spent / whole, PARTS[name])
        for name, spent in sums.items()
    ]
    rows.append(("sum", whole / len(known), whole, 100.0, f"{len(known)} runs"))
    notes = ["A run is one fit of one capture; runs that go side by side are added up."]
    if len(known) < len(every):
        notes.append(f"{len(every) - len(known)} of {len(every)} runs say nothing of it.")
    return Table("Where the seconds go", columns, tuple(rows), tuple(notes), breaks=(len(PARTS),))
