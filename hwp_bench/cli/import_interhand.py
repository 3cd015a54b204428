"""`hwp-bench data import interhand26m`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

_EXAMPLES = """examples:
  hwp-bench data import interhand26m InterHand2.6M touchrom-15 -o captures/touchrom-15
  hwp-bench data import interhand26m InterHand2.6M handscratch-16 -o scratch --mano mano_v1_2/models
  hwp-bench data import interhand26m InterHand2.6M Capture0/ROM01_No_Interaction/cam400262 -o x

DIR holds images/ and annotations/. The paper's three sequences have the names touchrom-15,
touchrom-16 and handscratch-16. The data set may not be used commercially (CC BY-NC 4.0).
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Make a capture of a sequence of InterHand2.6M."
    parser.epilog = _EXAMPLES
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the data set")
    parser.add_argument("sequence", metavar="SEQUENCE", help="a name, or CaptureN/SEQUENCE/camID")
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="OUT", help="capture folder to make"
    )
    parser.add_argument(
        "--mano",
        type=Path,
        metavar="MANO_DIR",
        help="your MANO files; without them the free hand is fitted",
    )
    parser.add_argument(
        "--size", type=int, default=256, metavar="PX", help="edge of the frames (default: 256)"
    )
    parser.add_argument(
        "--fps",
        type=float,
        default=5.0,
        help="frame rate of the annotated frames, 5 or 30 (default: 5)",
    )
    parser.add_argument(
        "--side",
        choices=("auto", "right", "left", "both"),
        default="auto",
        help="which hands (default: auto, those that the sequence is said to show)",
    )
    parser.add_argument("--force", action="store_true", help="replace an existing capture")
    parser.add_argument("--json", action="store_true", help="print the facts as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.files import check_places
    from hwp_bench.importers.interhand import InterHandImport, find_sequence, import_interhand

    check_places(
        {"--out": args.out},
        {"DIR": args.folder, "--mano": args.mano},
        replaces=args.force,
        makes_captures=True,
    )
    options = InterHandImport(
        mano=args.mano, size=args.size, fps=args.fps, side=args.side, overwrite=args.force
    )
    facts = import_interhand(args.folder, find_sequence(args.sequence), args.out, options)
    if args.json:
        print(json.dumps({"out": str(args.out), **facts}, indent=1))
        return 0
    print(f"capture: {args.out}, {facts['frames']} frames of {facts['split']}")
    for side, error in facts["errors"].items():
        joints = "unknown" if error["joints_mm"] is None else f"{error['joints_mm']:.2f} mm"
        print(f"{side} hand: in {error['frames_valid']} frames, joints {joints} from the annotated")
    print(f"look at: {args.out}/extra/overlay.png")
    return 0
