"""`wildghand pretrain`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

_EXAMPLES = """examples:
  wildghand pretrain anna ben carl -o my_prior
  wildghand pretrain simulated/* -o my_prior --steps 6000
  wildghand fit dora -o dora_avatar --prior my_prior

Give captures of several people, one or more of each, and none that a score will be taken on. A
stopped run goes on when the same command is given again.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "captures", type=Path, nargs="+", metavar="CAPTURE", help="what to fit jointly"
    )
    parser.add_argument("-o", "--out", type=Path, required=True, help="prior to make, a folder")
    parser.add_argument(
        "--steps",
        type=int,
        help="optimizer steps over all captures (default: those of a fit for each capture)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the fit (wildghand/model/settings.py); may be given again",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing prior")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.errors import UsageError
    from hwp_bench.base.files import check_places
    from hwp_bench.cli.options import overrides
    from wildghand.pretrain.session import pretrain
    from wildghand.prior.files import WEIGHTS

    check_places({"--out": args.out}, {"CAPTURE": args.captures}, replaces=args.overwrite)
    if args.steps is not None and args.steps < 1:
        raise UsageError(f"is {args.steps}", field="--steps", remedy="Use 1 or more.")
    if args.seed < 0:
        raise UsageError(f"is {args.seed}", field="--seed", remedy="Use 0 or more.")
    record = pretrain(
        args.captures,
        args.out,
        settings=overrides(args.set),
        steps=args.steps,
        seed=args.seed,
        overwrite=args.overwrite,
    ).record
    size = (args.out / WEIGHTS).stat().st_size
    if args.json:
        facts = {"prior": str(args.out), "captures": len(record.captures), "steps": record.steps}
        print(json.dumps({**facts, "bytes": size, "weights": record.weights}))
    else:
        print(
            f"{args.out}: {len(record.captures)} captures, {record.steps} steps, "
            f"{size / 1e6:.1f} MB"
        )
    return 0
