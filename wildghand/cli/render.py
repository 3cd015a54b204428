"""`wildghand render`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

_EXAMPLES = """examples:
  wildghand render my_avatar --poses my_capture -o frames
  wildghand render my_avatar --poses other_capture -o frames --frames 100:200 --background 255
  wildghand render my_avatar --poses my_capture -o frames --video turn.mp4
  wildghand render my_avatar --poses my_capture -o frames --overwrite   # in place of older frames

The poses are those of a capture: its hand parameters and cameras. PNG files are named by frame.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("avatar", type=Path, help="avatar folder")
    parser.add_argument(
        "--poses", type=Path, required=True, metavar="CAPTURE", help="capture to take poses from"
    )
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of images to make")
    parser.add_argument("--frames", metavar="A:B", help="frames A to B-1 only")
    parser.add_argument(
        "--background", type=int, default=0, metavar="GREY", help="0 black to 255 white"
    )
    parser.add_argument("--video", type=Path, metavar="MP4", help="also write a video")
    parser.add_argument(
        "--hand-model", metavar="MODEL", help="anny or mano:PATH (default: the avatar's own)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing folder")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.errors import UsageError
    from hwp_bench.base.files import check_places
    from hwp_bench.capture import open_capture
    from wildghand.avatar.files import load_avatar
    from wildghand.avatar.render import render_clip

    if not 0 <= args.background <= 255:
        raise UsageError(f"is {args.background}", field="--background", remedy="Use 0 to 255.")
    inputs = {"AVATAR": args.avatar, "--poses": args.poses}
    check_places({"--out": args.out, "--video": args.video}, inputs, replaces=args.overwrite)
    avatar = load_avatar(args.avatar, hand=args.hand_model)
    capture = open_capture(args.poses)
    frames = _frames(args.frames, capture.info.frame_count)
    facts = render_clip(
        avatar,
        capture,
        frames,
        args.out,
        background=args.background,
        video=args.video,
        overwrite=args.overwrite,
    )
    if args.json:
        print(json.dumps(facts))
    else:
        print(f"{args.out}: {facts['frames']} frames, {facts['frames_per_second']:.1f} a second")
    return 0


def _frames(text: str | None, count: int) -> range:
    from hwp_bench.base.errors import UsageError

    if text is None:
        return range(count)
    first, colon, last = text.partition(":")
    try:
        start, stop = int(first or 0), int(last or count) if colon else int(first) + 1
    except ValueError:
        start = stop = -1
    if not 0 <= start < stop <= count:
        raise UsageError(
            f"{text!r} is not a part of {count} frames",
            field="--frames",
            remedy="Use A:B, as 0:10.",
        )
    return range(start, stop)
