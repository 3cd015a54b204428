"""`wildghand explain`."""

from __future__ import annotations

import argparse
from pathlib import Path

_EXAMPLES = """examples:
  wildghand explain my_avatar my_capture -o explained.png
  wildghand explain my_avatar my_capture --frames 3 17 40 -o explained.png

Shows what the biases took out of training frames: the frame, the hand without biases (what the
avatar is), the hand with the frame's biases, and the difference of the two. Without --frames the
eight frames of largest temporal weight are shown. The capture is the one that was fitted.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("avatar", type=Path, help="avatar folder")
    parser.add_argument("capture", type=Path, help="capture folder that it was fitted to")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="PNG file")
    parser.add_argument(
        "--frames", type=int, nargs="+", action="extend", metavar="N", help="frames of the capture"
    )
    parser.add_argument(
        "--hand-model", metavar="MODEL", help="anny or mano:PATH (default: the avatar's own)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.files import check_places
    from hwp_bench.base.images import write_image
    from hwp_bench.capture import open_capture
    from wildghand.avatar.files import load_avatar
    from wildghand.avatar.render import explain_frames, explanation_sheet

    check_places({"--out": args.out}, {"AVATAR": args.avatar, "CAPTURE": args.capture})
    capture = open_capture(args.capture)
    found = explain_frames(load_avatar(args.avatar, hand=args.hand_model), capture, args.frames)
    names = {
        item.frame: ", ".join(
            kind.replace("_", " ")
            for kind, level in capture.info.severity(item.frame).items()
            if level
        )
        for item in found
    }
    write_image(args.out, explanation_sheet(found, names))
    print(f"{args.out}: {len(found)} frames")
    return 0
