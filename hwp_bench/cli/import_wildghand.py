"""`hwp-bench data import wildghand`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

_EXAMPLES = """examples:
  hwp-bench data import wildghand WildGHand/capture0_subsample3_single -o captures/capture0
  hwp-bench data import wildghand WildGHand -o captures --mano mano_v1_2/models
  hwp-bench data import wildghand WildGHand -o compat --mano mano_v1_2/models --official-compat

DIR is one folder of the release (with output.pkl), or a folder of them; then OUT gets one capture
for each. Pickles are read without running code from them. Without --mano the free hand is fitted,
and its error is printed in mm. docs/data.md describes every step from the download to a table.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Make captures of the official HWP release."
    parser.epilog = _EXAMPLES
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the release")
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
        "--official-compat",
        action="store_true",
        help="crop, intrinsics and translations as in the released loader",
    )
    parser.add_argument(
        "--hand", choices=("right", "left"), help="the hand of a single-hand capture"
    )
    parser.add_argument("--id", metavar="ID", help="capture id (default: by the folder's name)")
    parser.add_argument(
        "--size", type=int, default=256, metavar="PX", help="edge of the frames (default: 256)"
    )
    parser.add_argument(
        "--fps",
        type=float,
        default=30.0,
        help="frame rate of the video before subsampling (default: 30)",
    )
    parser.add_argument("--force", action="store_true", help="replace an existing capture")
    parser.add_argument("--json", action="store_true", help="print the facts as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import notice
    from hwp_bench.base.files import check_places
    from hwp_bench.importers.official import OfficialImport, import_official
    from hwp_bench.importers.official.folders import find_folders

    check_places(
        {"--out": args.out},
        {"DIR": args.folder, "--mano": args.mano},
        replaces=args.force,
        makes_captures=True,
    )
    options = OfficialImport(
        mano=args.mano,
        official_compat=args.official_compat,
        hand=args.hand,
        size=args.size,
        video_fps=args.fps,
        overwrite=args.force,
    )
    folders = find_folders(args.folder, args.id)
    several = folders[0].path != args.folder
    results = []
    for folder in folders:
        out = args.out / folder.id if several else args.out
        facts = import_official(folder, out, options)
        for warning in facts["warnings"]:
            notice(f"warning: {folder.path}: {warning}")
        results.append({"out": str(out), **facts})
    if args.json:
        print(json.dumps(results, indent=1))
    else:
        for facts in results:
            _print(facts)
    return 0


def _print(facts: dict[str, Any]) -> None:
    valid = ", ".join(f"{side} in {count}" for side, count in facts["frames_valid"].items())
    print(f"capture: {facts['out']}, {facts['frames']} frames, hands: {valid}")
    for side, error in facts["vertex_error_mm"].items():
        print(
            f"{side} hand ({facts['hand_model']}): {error:.2f} mm from the tracker's vertices, "
            f"joints {facts['joint_error_px'][side]:.2f} px from its joints, "
            f"{100 * facts['vertices_on_mask'][side]:.0f} % of its vertices on the mask"
        )
    print(f"look at: {facts['out']}/extra/overlay.png")
