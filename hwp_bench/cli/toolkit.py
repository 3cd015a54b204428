"""What the toolkit has, and whether it works here: `list`, `stability`, `completion`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from hwp_bench.cli.options import add_json, print_json
from hwp_bench.cli.program import add_shell_argument, completion_script

if TYPE_CHECKING:
    from hwp_bench.base.tables import Table
    from hwp_bench.stability import Case, CaseOutcome

_TOPICS = ("captures", "perturbations", "suites", "methods", "metrics")

_LIST = """examples:
  hwp-bench list
  hwp-bench list metrics
  hwp-bench list captures --json
"""


def add_list(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `list`."""
    parser.epilog = _LIST
    parser.add_argument(
        "topic", nargs="?", choices=_TOPICS, help="what to list (default: everything)"
    )
    add_json(parser)


def do_list(args: argparse.Namespace) -> int:
    """Run `list`."""
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
        print_json(value)
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


_STABILITY = """examples:
  hwp-bench stability
  hwp-bench stability --group splat --backend numba
  hwp-bench stability --json > stability.json
"""


def add_stability(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `stability`."""
    parser.epilog = _STABILITY
    parser.add_argument(
        "--backend",
        action="append",
        default=[],
        metavar="NAME",
        help="only on this backend (may be repeated; default: every one that this machine has)",
    )
    parser.add_argument(
        "--group",
        action="append",
        default=[],
        metavar="NAME",
        help="only this part of the product (may be repeated; default: all)",
    )
    parser.add_argument(
        "--provider",
        action="append",
        default=[],
        metavar="MODULE:FUNCTION",
        help="more cases, besides those of installed packages (may be repeated)",
    )
    add_json(parser)


def do_stability(args: argparse.Namespace) -> int:
    """Run `stability`; 1 if anything that must hold does not."""
    from hwp_bench.base.console import notice
    from hwp_bench.stability import find_cases, run_cases

    cases = find_cases(args.group, args.provider)
    _check_backends(cases, args.backend)
    outcomes = []
    for outcome in run_cases(cases, args.backend):
        outcomes.append(outcome)
        if not outcome.measured.passed:
            notice(f"failed: {outcome.case.name}: {outcome.measured.text}")
    if args.json:
        print_json([_as_object(outcome) for outcome in outcomes])
    else:
        _print_stability(outcomes)
    return 0 if all(outcome.measured.passed for outcome in outcomes) else 1


def _check_backends(cases: list[Case], asked: list[str]) -> None:
    from hwp_bench.base.errors import UsageError

    known = sorted({name for case in cases for name in case.backends if name})
    for name in asked:
        if name not in known:
            raise UsageError(
                f"no case can run on {name!r} here",
                field="--backend",
                remedy=f"This machine has {', '.join(known) or 'no choice of backends'}",
            )


def _as_object(outcome: CaseOutcome) -> dict[str, Any]:
    return {
        "group": outcome.case.group,
        "case": outcome.case.name,
        "backend": outcome.backend,
        "must_hold": outcome.case.must_hold,
        "measured": outcome.measured.text,
        "passed": outcome.measured.passed,
        "seconds": round(outcome.seconds, 4),
    }


def _print_stability(outcomes: list[CaseOutcome]) -> None:
    from hwp_bench.base.tables import Column, Table, print_table

    titles = ("case", "backend", "what must hold", "measured", "pass")
    rows = tuple(
        (
            f"{outcome.case.group}: {outcome.case.name}",
            outcome.backend,
            outcome.case.must_hold,
            outcome.measured.text,
            "yes" if outcome.measured.passed else "NO",
        )
        for outcome in outcomes
    )
    print_table(Table("Numerical hard cases", tuple(Column(title) for title in titles), rows))
    passed = sum(outcome.measured.passed for outcome in outcomes)
    print(f"{passed} of {len(outcomes)} passed")


def add_completion(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `completion`."""
    add_shell_argument(parser, "hwp-bench")


def do_completion(args: argparse.Namespace) -> int:
    """Run `completion`."""
    from hwp_bench.cli.main import command_tree

    print(completion_script("hwp-bench", command_tree(), args.shell))
    return 0


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "list": (add_list, do_list),
    "stability": (add_stability, do_stability),
    "completion": (add_completion, do_completion),
}
