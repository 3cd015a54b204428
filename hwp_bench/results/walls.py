"""Which captures of an evaluation a method ran on without walls, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hwp_bench.base.tables import Table
from hwp_bench.results.schema import Results

#: What `CaptureResult.isolation` says of a run inside the walls.
WALLED = "namespaces"
#: What `Results.environment` says under `caches`: a run finds nothing that a method wrote before.
NEW_CACHES = "new for each run"


def without_walls(results: Results) -> dict[str, list[str]]:
    """Return the ids of the captures that a method ran on without walls, by the reason.

    The reason is empty where a person asked for none. Predictions that came as files, and results
    of versions that recorded nothing, are left out.
    """
    found: dict[str, list[str]] = {}
    for capture in results.captures:
        if capture.isolation is not None and capture.isolation != WALLED:
            _, _, reason = capture.isolation.partition(" ")
            found.setdefault(reason.strip("()"), []).append(capture.id)
    return found


def walls_text(results: Results, head: str = "") -> str:
    """Say how the method's process was isolated; empty where nothing is known of it.

    Args:
        results: an evaluation.
        head: what its captures' names begin with, such as a variant and a seed.
    """
    open_runs = without_walls(results)
    if not open_runs:
        walled = any(capture.isolation == WALLED for capture in results.captures)
        return f"isolation: {head}{WALLED}" if walled else ""
    parts = [
        ", ".join(ids) + (f" (the system refuses them: {reason})" if reason else "")
        for reason, ids in open_runs.items()
    ]
    return (
        f"warning: {head}no isolation on {'; '.join(parts)}. The method could read every file that "
        "its user can read, test frames among them, and use the network. --isolation required "
        "refuses to run without walls."
    )


def walls_note(results: Sequence[Results]) -> str:
    """Return a line under a table that names methods which ran without walls; empty if none did."""
    titles = [one.method.title for one in results if without_walls(one)]
    names = ", ".join(dict.fromkeys(titles))
    return f"Run without walls, where test frames can be read: {names}." if names else ""


def noted(table: Table, results: Sequence[Results]) -> Table:
    """Return a table with `walls_note` below it, once."""
    note = walls_note(results)
    if not note or note in table.notes:
        return table
    return replace(table, notes=(*table.notes, note))
