"""`hwp-bench list`."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hwp_bench.base.tables import Table

_TOPICS = ("captures", "perturbations", "suites", "methods", "metrics")

_EXAMPLES = """examples:
  hwp-bench list
  hwp-bench list metrics
  hwp-bench list captures --json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "topic", nargs="?", choices=_TOPICS, help="what to list (default: everything)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.tables import print_table, to_object

    makers = {
        "captures": _captures,
        "perturbations": _perturbations,
        "suites": _suites,
        "methods": _methods,
        "metrics": _metrics,
    }
    tables = {topic: makers[topic]() for topic in ([args.topic] if args.topic else _TOPICS)}
    if args.json:
        value = {topic: to_object(table)["rows"] for topic, table in tables.items()}
        json.dump(value, sys.stdout, indent=1)
        print()
    else:
        for table in tables.values():
            print_table(table)
    return 0


def _captures() -> Table:
    from hwp_bench.base.tables import Column, Table
    from hwp_bench.taxonomy import catalogue

    columns = ("capture", "hands", "action", "device", "frames", "perturbations")
    rows = tuple(
        (
            entry.id,
            entry.hands,
            entry.action,
            entry.device,
            entry.frame_count,
            ", ".join(entry.perturbations),
        )
        for entry in catalogue().values()
    )
    return Table("Captures of the HWP data set", tuple(map(Column, columns)), rows)


def _perturbations() -> Table:
    from hwp_bench.base.tables import Column, Table
    from hwp_bench.taxonomy import PERTURBATIONS, catalogue, perturbation

    rows = tuple(
        (
            name,
            perturbation(name).description,
            sum(name in entry.perturbations for entry in catalogue().values()),
        )
        for name in PERTURBATIONS
    )
    columns = (Column("perturbation"), Column("what it does"), Column("captures"))
    return Table("Perturbations", columns, rows)


def _suites() -> Table:
    from hwp_bench.base.tables import Column, Table
    from hwp_bench.sim import suite
    from hwp_bench.taxonomy import SUITES

    rows = []
    for name in SUITES:
        items = suite(name)
        rows.append(
            (
                name,
                len(items),
                sum(item.frame_count for item in items),
                f"{items[0].size} px",
                ", ".join(item.scene.id for item in items),
            )
        )
    columns = ("suite", "captures", "frames", "size", "which")
    return Table("Suites of simulated captures", tuple(map(Column, columns)), tuple(rows))


def _methods() -> Table:
    from hwp_bench.base.tables import Column, Table
    from hwp_bench.methods.manifest import shipped_methods

    rows = tuple(
        (
            method.name,
            method.title,
            ", ".join(method.presets),
            ", ".join(method.switches) or "-",
            method.authors or "-",
            method.licence or "-",
            method.url or "-",
            method.description,
        )
        for method in shipped_methods()
    )
    names = ["method", "title", "presets", "switches", "authors", "licence", "url", "description"]
    return Table("Methods that ship with the toolkit", tuple(map(Column, names)), rows)


def _metrics() -> Table:
    from hwp_bench.base.tables import Column, Table
    from hwp_bench.metrics import METRICS

    rows = tuple(
        (
            metric.name,
            metric.protocol,
            metric.unit or "-",
            "higher" if metric.higher_is_better else "lower",
            metric.penalty,
            f"{metric.description} [{metric.reference}]",
        )
        for metric in METRICS
    )
    columns = ("metric", "protocol", "unit", "better", "penalty", "what it measures")
    return Table("Metrics", tuple(map(Column, columns)), rows)
