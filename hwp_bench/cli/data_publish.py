"""`hwp-bench data publish`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

_EXAMPLES = """examples:
  hwp-bench data publish captures/* -o publication
  hwp-bench data publish captures/* -o publication --splits splits/mine.json
  hwp-bench evaluate submission/ --sealed publication/sealed

publication/public goes to authors: training and validation frames, and the hand parameters and
cameras of every frame. publication/sealed stays with the keeper: it holds the test frames, and the
salt of the commitment that the public manifest carries.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Divide captures into a public and a sealed part."
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "captures", nargs="+", type=Path, metavar="CAPTURES", help="capture folders"
    )
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="DIR", help="folder to make"
    )
    parser.add_argument("--splits", type=Path, help="split file (default: the 80/10/10 rule)")
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.files import check_places
    from hwp_bench.capture.splits import read_splits
    from hwp_bench.commitments import publish

    check_places({"--out": args.out}, {"CAPTURES": args.captures, "--splits": args.splits})
    splits = read_splits(args.splits) if args.splits else None
    made = publish(args.captures, args.out, splits=splits)
    if args.json:
        value = {
            "public": str(made.public),
            "sealed": str(made.sealed),
            "commitment": made.commitment,
            "captures": list(made.captures),
        }
        print(json.dumps(value, indent=1))
        return 0
    print(f"captures: {', '.join(made.captures)}")
    print(f"for authors: {made.public}")
    print(f"keep secret: {made.sealed}")
    print(f"commitment: {made.commitment}")
    return 0
