"""`hwp-bench hands convert`."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

_EXAMPLES = """examples:
  hwp-bench hands convert my_capture as_mano --hand-model mano:mano_v1_2/models
  hwp-bench hands convert mano_capture as_free --hand-model anny --json

Writes the capture again with its hands in another hand model, by fitting, and prints the errors
of the fit. True hand parameters are left out: they belong to the old model.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Convert a capture's hands to another hand model."
    parser.epilog = _EXAMPLES
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="capture folder")
    parser.add_argument("out", type=Path, metavar="OUT", help="capture folder to make")
    parser.add_argument(
        "--hand-model", required=True, metavar="MODEL", help="anny, mano:PATH or mano-hd:PATH"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing capture")
    parser.add_argument("--json", action="store_true", help="print the errors as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.files import check_places
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.convert import convert_capture

    check_places(
        {"OUT": args.out}, {"CAPTURE": args.capture}, replaces=args.force, makes_captures=True
    )
    errors = convert_capture(
        open_capture(args.capture), args.out, args.hand_model, overwrite=args.force
    )
    if args.json:
        print(json.dumps({side: asdict(error) for side, error in errors.items()}, indent=1))
        return 0
    for side, error in errors.items():
        print(
            f"{side} hand: skin {error.skin_mm:.2f} mm (worst frame {error.worst_skin_mm:.2f}), "
            f"landmarks {error.landmark_mm:.2f} mm"
        )
    print(f"capture: {args.out}")
    return 0
