"""Checks of the parts of a result that no pixel decides: labels, keys, copies, tables, digests."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import HwpError
from hwp_bench.base.files import inside, read_json
from hwp_bench.base.tables import FORMATS, Table, format_table
from hwp_bench.capture import Capture
from hwp_bench.evaluation.completeness import is_of_suite, missing, other_captures
from hwp_bench.evaluation.evaluation_key import key_of
from hwp_bench.report.tables import all_tables, free_view_tables
from hwp_bench.results import CaptureResult, Results
from hwp_bench.results.bounds import MAX_BYTES
from hwp_bench.results.store import content_digest
from hwp_bench.sim.produce.suites import suite_names

#: Longest value of a field that a difference repeats.
_SHOWN = 100


@dataclass(frozen=True)
class Discrepancy:
    """One part of a result that is not as the result says."""

    #: Id of the capture; empty for the whole result.
    capture: str
    #: The part that was verified: `capture`, `split`, `frames`, `predictions`, `protocols`, a label
    #: (`hands`, `perturbations`, `exact_masks`, `made_by`), `key`, `suite`, `digest`, a stored
    #: copy or table, or a frame and metric.
    what: str
    #: Its value in the result.
    recorded: str
    #: Its value as it was found.
    found: str


def label_differences(record: CaptureResult, capture: Capture, exact: bool) -> list[Discrepancy]:
    """Compare what a result says of a capture with what the capture says of itself.

    Args:
        record: the capture's part of the result.
        capture: the capture, of the same digest.
        exact: whether the masks of all test frames are exact coverage.
    """
    info = capture.info
    wanted = {
        "hands": info.hands,
        "perturbations": list(info.perturbations),
        "exact_masks": exact,
        "made_by": info.made_by,
    }
    # Who made the parameters was not recorded at first.
    if record.made_by is None:
        del wanted["made_by"]
    return [
        Discrepancy(record.id, name, _brief(getattr(record, name)), _brief(value))
        for name, value in wanted.items()
        if getattr(record, name) != value
    ]


def failure_differences(record: CaptureResult) -> list[Discrepancy]:
    """Look for scored frames of a method that is said to have failed on the whole capture."""
    scored = sum(frame.failure is None for frame in record.frames)
    if record.failure is None or not scored:
        return []
    return [Discrepancy(record.id, "failure", "every frame", f"{scored} frames have predictions")]


def key_differences(results: Results, record: CaptureResult, clip: str | None) -> list[Discrepancy]:
    """Compute the key of a capture again: it binds method, settings, seed, budget and protocols.

    Args:
        results: the result.
        record: one of its captures.
        clip: digest of the capture's free-view clip; None where it has none.
    """
    # A clip that was made after the evaluation is in no key of it.
    keys = {key_of(results, record, digest) for digest in {None, clip}}
    if record.free_view is not None:
        keys = {key_of(results, record, record.free_view.digest)}
    if record.key in keys:
        return []
    found = "another: method, settings, seed, budget, frames, protocols or metrics were changed"
    return [Discrepancy(record.id, "key", record.key, found)]


def suite_differences(
    results: Results, captures: Sequence[Capture], *, own_splits: bool = False
) -> list[Discrepancy]:
    """Compare a result with the suite that it names: captures, splits, frames and scenes.

    Args:
        results: the result.
        captures: those of its captures that were found, of the same digests.
        own_splits: the person has splits of their own, so that the suite's are not asked for.
    """
    if results.suite not in suite_names():
        return []
    problems = other_captures(results) if own_splits else missing(results)
    foreign = [item.info.id for item in captures if not is_of_suite(item.info, results.suite)]
    if foreign:
        problems.append(f"is of other scenes or sizes: {', '.join(foreign)}")
    return [Discrepancy("", "suite", results.suite, problem) for problem in problems]


def digest_differences(value: Mapping[str, Any], *, expected: bool) -> list[Discrepancy]:
    """Compare a result file with the digest that it states of its own content.

    Args:
        value: the file as JSON.
        expected: whether the file was made by this code, which always states one.
    """
    stated, found = content_digest(value)
    if stated == found or (stated is None and not expected):
        return []
    return [Discrepancy("", "digest", _brief(stated), found)]


def copy_differences(root: Path, value: Mapping[str, Any], name: str) -> list[Discrepancy]:
    """Compare each capture of a result file with the copy of it next to its predictions.

    Args:
        root: folder of the result file.
        value: the file as JSON, which has been read as a result.
        name: of the copies, in the folders of captures. Those that are not there are left out.
    """
    found = []
    for record in value["captures"]:
        place = f"captures/{record['id']}/{name}"
        try:
            path = inside(root, place)
            if not path.is_file():
                continue
            copy = read_json(path, max_bytes=MAX_BYTES)
        except HwpError as error:
            found.append(Discrepancy(record["id"], name, "a copy of this capture", error.problem))
            continue
        copy = copy if isinstance(copy, dict) else {}
        odd = [key for key in {*record, *copy} if record.get(key) != copy.get(key)]
        found += [
            Discrepancy(
                record["id"], f"{name}, {key}", _brief(record.get(key)), _brief(copy.get(key))
            )
            for key in sorted(odd)
        ]
    return found


def table_differences(root: Path, results: Results) -> list[Discrepancy]:
    """Make the tables that an evaluation wrote next to its result again, and compare them.

    Args:
        root: folder of the result file; tables that are not there are left out.
        results: the result.
    """
    try:
        tables = {**all_tables([results]), **free_view_tables([results])}
    except HwpError as error:
        return [Discrepancy("", "tables", "tables of the result", error.problem)]
    return [item for name, table in tables.items() for item in _one_table(root, name, table)]


def _one_table(root: Path, name: str, table: Table) -> list[Discrepancy]:
    found = []
    for ending in FORMATS:
        what = f"tables/{name}.{ending}"
        try:
            path = inside(root, what)
            text = path.read_text("utf-8") if path.is_file() else None
        except (HwpError, OSError, UnicodeDecodeError):
            text = ""
        if text is None or text == format_table(table, ending):
            continue
        place = _first_difference(text, format_table(table, ending))
        found.append(Discrepancy("", what, *place))
    return found


def _first_difference(stored: str, made: str) -> tuple[str, str]:
    """Return the first line in which two texts differ."""
    first, second = stored.splitlines(), made.splitlines()
    size = max(len(first), len(second))
    lines = zip(
        [*first, *[""] * (size - len(first))], [*second, *[""] * (size - len(second))], strict=True
    )
    return next(((a[:_SHOWN], b[:_SHOWN]) for a, b in lines if a != b), ("", "other line ends"))


def _brief(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
