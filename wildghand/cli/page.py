"""`wildghand page`."""

from __future__ import annotations

import argparse
from pathlib import Path

_EXAMPLES = """examples:
  wildghand page my_avatar
  wildghand page my_avatar --poses my_capture -o hand.html

Writes one HTML file that works offline in a browser with WebGL2: the hand can be turned and posed.
With the capture that was fitted its motion is played, too, and the page says how near it comes to
the avatar's own drawing.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("avatar", type=Path, help="avatar folder")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("avatar.html"),
        metavar="FILE",
        help="file to write (default: avatar.html)",
    )
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="CAPTURE",
        help="capture that was fitted, for its motion (default: what a fit of a video left)",
    )
    parser.add_argument(
        "--hand-model", metavar="MODEL", help="anny or mano:PATH (default: the avatar's own)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    import dataclasses
    import json

    from hwp_bench.base.files import check_places
    from hwp_bench.capture import open_capture
    from wildghand.page import write_page
    from wildghand.viewer.posed_view import capture_of

    check_places({"--out": args.out}, {"AVATAR": args.avatar, "--poses": args.poses})
    place = args.poses or capture_of(args.avatar)
    capture = None if place is None else open_capture(place)
    facts = write_page(
        args.avatar, args.out, capture=capture, hand=args.hand_model, overwrite=args.overwrite
    )
    if args.json:
        print(json.dumps(dataclasses.asdict(facts)))
        return 0
    print(f"{args.out}: {facts.gaussians} Gaussians, {facts.bytes / 1e6:.2f} MB")
    if facts.fidelity is not None:
        print(
            f"{facts.fidelity.baked:.1f} dB from the avatar's own drawing "
            f"({facts.fidelity.joints_only:.1f} dB if it followed the joints alone)"
        )
    return 0
