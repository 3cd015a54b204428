"""`wildghand view`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from wildghand.cli.serving import add_address, address_of

_EXAMPLES = """examples:
  wildghand view my_avatar
  wildghand view my_avatar --poses my_capture
  wildghand view my_avatar --port 9000 --background 40 40 40

Prints the address of a page and serves it until Ctrl-C. In the page the hand is turned with the
mouse, and posed with sliders in degrees, with named poses, or by the motion of a capture. The page
is for this machine only; --host 0.0.0.0 shows it to everybody who reaches the machine. It needs
viser: pip install 'hwp-bench[view]'.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("avatar", type=Path, help="avatar folder")
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="CAPTURE",
        help="capture whose motion is played (default: the one that the avatar was made of, where "
        "it lies with the avatar)",
    )
    add_address(parser)
    parser.add_argument(
        "--size", type=int, default=1024, metavar="PX", help="largest edge of a picture"
    )
    parser.add_argument(
        "--background",
        type=int,
        nargs=3,
        default=(255, 255, 255),
        metavar=("R", "G", "B"),
        help="colour behind the hand, 0 to 255 each (default: white)",
    )
    parser.add_argument(
        "--hand-model", metavar="MODEL", help="anny or mano:PATH (default: the avatar's own)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command; Ctrl-C ends it with status 0."""
    import threading

    from hwp_bench.capture import open_capture
    from wildghand.avatar.files import load_avatar
    from wildghand.viewer.posed_view import Motion, capture_of
    from wildghand.viewer.server import require_viser
    from wildghand.viewer.view import ViewSettings, serve_view

    red, green, blue = args.background
    settings = ViewSettings(args.size, (red, green, blue))
    require_viser()
    avatar = load_avatar(args.avatar, hand=args.hand_model)
    poses = args.poses or capture_of(args.avatar)
    motion = None if poses is None else Motion(avatar, open_capture(poses))
    try:
        with serve_view(avatar, motion, address_of(args), settings) as served:
            facts = {"avatar": str(args.avatar), "url": served.url}
            text = json.dumps(facts) if args.json else f"{args.avatar}: {served.url}"
            print(text, flush=True)
            threading.Event().wait()
    except KeyboardInterrupt:
        pass
    return 0
