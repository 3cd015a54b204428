"""`hwp-bench stability`."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hwp_bench.stability import Case, CaseOutcome

_EXAMPLES = """examples:
  hwp-bench stability
  hwp-bench stability --group splat --backend numba
  hwp-bench stability --json > stability.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
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
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command; 1 if anything that must hold does not."""
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
        json.dump([_as_object(outcome) for outcome in outcomes], sys.stdout, indent=1)
        print()
    else:
        _print(outcomes)
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


def _print(outcomes: list[CaseOutcome]) -> None:
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
