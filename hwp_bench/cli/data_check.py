"""`hwp-bench data check`."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hwp_bench.capture.check import CheckReport

_EXAMPLES = """examples:
  hwp-bench data check my_capture
  hwp-bench data check --json captures/*

Exit status 0: every capture is sound; 1: at least one is not.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("captures", nargs="+", metavar="CAPTURE", help="capture folder")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import track
    from hwp_bench.capture.check import check_capture

    reports = [check_capture(path) for path in track(args.captures, "checking captures")]
    if args.json:
        json.dump([{"ok": report.ok, **asdict(report)} for report in reports], sys.stdout, indent=1)
        print()
    else:
        for report in reports:
            _print(report)
    return 0 if all(report.ok for report in reports) else 1


def _print(report: CheckReport) -> None:
    from hwp_bench.base.errors import shown
    from hwp_bench.base.tables import Column, Table, print_table

    title = shown(report.path)
    verdict = "sound" if report.ok else "NOT SOUND"
    rows = tuple((name, _fact(value)) for name, value in report.facts.items())
    if rows:
        columns = (Column("fact"), Column("value"))
        print_table(Table(f"{title}: {verdict}", columns, rows))
    else:
        print(f"{title}: {verdict}")
    for finding in report.findings:
        parts = (finding.level, finding.where, finding.field, finding.problem)
        remedy = f" {finding.remedy}" if finding.remedy else ""
        said = ": ".join(part for part in parts if part)
        print(shown(f"{said}.{remedy}").replace("\n", " "))


def _fact(value: object) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, dict):
        known = {key: "unknown" if item is None else item for key, item in value.items()}
        return ", ".join(f"{key} {item}" for key, item in known.items()) or "none"
    if isinstance(value, list):
        return ", ".join(str(item) for item in value) or "none"
    return str(value)
