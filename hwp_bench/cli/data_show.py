"""`hwp-bench data show`."""

from __future__ import annotations

import argparse
from pathlib import Path

_EXAMPLES = """examples:
  hwp-bench data show my_capture
  hwp-bench data show my_capture -o sheet.png --count 48 --edge 192

The sheet shows frames evenly over the capture: green the visible-hand mask, orange the right
and blue the left estimated hand; over each frame its number and the severity of what perturbs
it (hoi: interaction, cp: complex poses, il: illumination, mb: motion blur).
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("capture", metavar="CAPTURE", help="capture folder")
    parser.add_argument("-o", "--out", help="PNG to write (default: ID-sheet.png here)")
    parser.add_argument("--count", type=int, default=24, help="frames on the sheet (default 24)")
    parser.add_argument(
        "--edge", type=int, default=256, help="larger side of a frame, px (default 256)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.errors import UsageError
    from hwp_bench.base.files import check_places
    from hwp_bench.base.images import write_image
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.check import contact_sheet

    if args.count < 1 or not 16 <= args.edge <= 2048:
        raise UsageError("at least one frame, of 16 to 2048 px, is drawn", field="--count, --edge")
    capture = open_capture(args.capture)
    out = Path(args.out or f"{capture.info.id}-sheet.png")
    check_places({"--out": out}, {"CAPTURE": args.capture})
    print(write_image(out, contact_sheet(capture, count=args.count, edge=args.edge)))
    return 0
