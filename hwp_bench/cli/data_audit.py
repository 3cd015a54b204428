"""`hwp-bench data audit`."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hwp_bench.capture.splits import AuditReport

_EXAMPLES = """examples:
  hwp-bench data audit my_capture
  hwp-bench data audit my_capture --guard 15
  hwp-bench data audit captures/* --splits splits/hwp-v1.json --json

Exit status 0: parts are disjoint and no test frame is known to be perturbed; 1: otherwise.
Near-copies across the border are reported and do not change the status.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("captures", nargs="+", metavar="CAPTURE", help="capture folder")
    parser.add_argument("--splits", help="split file (default: the 80/10/10 rule)")
    parser.add_argument(
        "--guard", type=int, default=0, help="frames left out before each border (default 0)"
    )
    parser.add_argument("--json", action="store_true", help="print the reports as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import track
    from hwp_bench.base.errors import UsageError
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.splits import audit_split, contiguous_split, read_splits, split_for

    if args.guard < 0 or (args.guard and args.splits):
        raise UsageError("a guard gap is at least 0, and not for a split file", field="--guard")
    splits = read_splits(args.splits) if args.splits else None
    reports = []
    for path in track(args.captures, "auditing splits"):
        capture = open_capture(path)
        if splits is None:
            split = contiguous_split(capture.info.id, len(capture), guard=args.guard)
        else:
            split = split_for(capture.info.id, len(capture), splits)
        reports.append(audit_split(capture, split))
    if args.json:
        json.dump([{"ok": report.ok, **asdict(report)} for report in reports], sys.stdout, indent=1)
        print()
    else:
        for report in reports:
            _print(report)
    return 0 if all(report.ok for report in reports) else 1


def _print(report: AuditReport) -> None:
    from hwp_bench.base.tables import Column, Table, print_table

    closest = min(report.near_duplicates, key=lambda pair: pair[2], default=None)
    near = "none"
    if closest is not None:
        near = (
            f"{len(report.near_duplicates)}; the closest: test frame {closest[0]} and frame "
            f"{closest[1]}, RMS {closest[2]:.2f} levels; none with a guard gap of "
            f"{report.guard_needed} frames"
        )
    hashes = "none"
    if report.same_hashes:
        hashes = (
            f"{len(report.same_hashes)} pairs; none with a guard gap of "
            f"{report.guard_needed_by_hash} frames"
        )
    perturbed = ", ".join(f"{frame} ({name})" for frame, name in report.perturbed_test[:10])
    rows = (
        ("frames", ", ".join(f"{part} {count}" for part, count in report.counts.items())),
        ("in more than one part", str(list(report.overlap)) if report.overlap else "none"),
        ("in no part (guard gap)", str(len(report.left_out))),
        ("perturbed test frames", perturbed or "none known"),
        ("severity unknown for", ", ".join(report.unknown_severity) or "none"),
        ("near-copies across the border", near),
        ("one perceptual hash across the border", hashes),
    )
    verdict = "fair" if report.ok else "NOT FAIR"
    columns = (Column("question"), Column("answer"))
    print_table(Table(f"{report.capture}: {verdict}", columns, rows))
