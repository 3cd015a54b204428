"""The whole field: every method that ships, on the same captures with the same seconds.

Run from the repository:
`python -m benchmarks.field --suites wild-test mini --seeds 3 --seconds 64 -o runs/field --jobs 2`
evaluates the methods of `baselines/` and WildGHand suite by suite, with `hwp-bench evaluate`, which
gets every other argument. Started again it continues where it was stopped.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from hwp_bench.cli.main import main as hwp_bench
from hwp_bench.methods.manifest import shipped_methods


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--suites", nargs="+", required=True)
    parser.add_argument("--methods", nargs="+", help="some of them (default: all)")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=64.0, help="of each fit")
    parser.add_argument("-o", "--out", type=Path, default=Path("runs/field"))
    given, others = parser.parse_known_args()
    methods = given.methods or [method.name for method in shipped_methods()]
    limits = ["--seeds", f"{given.seeds}", "--budget", f"{given.seconds:g}"]
    status = 0
    for suite in given.suites:
        words = ["evaluate", *methods, "--suite", suite, *limits, "-o", f"{given.out / suite}"]
        print(shlex.join(["hwp-bench", *words, *others]), file=sys.stderr, flush=True)
        status |= hwp_bench([*words, *others])
    return status


if __name__ == "__main__":
    sys.exit(main())
