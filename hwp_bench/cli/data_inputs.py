"""`hwp-bench data inputs`."""

from __future__ import annotations

import argparse
import json
import shlex
from pathlib import Path

from hwp_bench.taxonomy import SUITES

_EXAMPLES = """examples:
  hwp-bench data inputs --suite mini -o inputs
  hwp-bench data inputs --capture my_capture -o inputs --name mine
  hwp-bench evaluate inputs/submission --suite mini      # once the predictions are there

For a program of your own that runs where and how it likes. inputs/requests/CAPTURE holds training
frames, masks, and the hand parameters and cameras of every frame; inputs/README.md says which
frames are to be drawn. The program writes them to inputs/submission/predictions/CAPTURE.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--suite",
        choices=SUITES,
        default="mini",
        help="simulated captures, rendered on first use (default mini)",
    )
    what.add_argument(
        "--capture",
        nargs="+",
        action="extend",
        metavar="PATH",
        help="capture folders, instead of a suite",
    )
    parser.add_argument("--splits", help="split file (default: the 80/10/10 rule)")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="new folder")
    parser.add_argument(
        "--name", default="mine", help="short name of your method in tables (default mine)"
    )
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.files import check_places
    from hwp_bench.capture.splits import read_splits
    from hwp_bench.commitments.inputs import check_place, write_inputs
    from hwp_bench.evaluation.evaluate import open_captures
    from hwp_bench.sim import ensure_suite

    # Before a suite is rendered.
    check_places({"--out": args.out}, {"--capture": args.capture, "--splits": args.splits})
    check_place(args.out, args.name)
    splits = read_splits(args.splits) if args.splits else None
    paths = [Path(path) for path in args.capture] if args.capture else ensure_suite(args.suite)
    data = ["--capture", *args.capture] if args.capture else ["--suite", args.suite]
    data += ["--splits", args.splits] if args.splits else []
    score = shlex.join(["hwp-bench", "evaluate", str(args.out / "submission"), *data])
    made = write_inputs(open_captures(paths, splits), args.out, name=args.name, score=score)
    if args.json:
        value = {
            "requests": str(made.requests),
            "submission": str(made.submission),
            "frames": dict(made.wanted),
            "score": score,
        }
        print(json.dumps(value, indent=1))
        return 0
    print(f"to read: {made.requests} ({len(made.wanted)} captures)")
    print(f"to fill: {made.submission}/predictions ({sum(made.wanted.values())} frames)")
    print(f"then: {score}")
    return 0
