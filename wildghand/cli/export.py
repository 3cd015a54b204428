"""`wildghand export`."""

from __future__ import annotations

import argparse
from pathlib import Path

_EXAMPLES = """examples:
  wildghand export my_avatar --ply hand.ply
  wildghand export my_avatar --ply hand.ply --poses my_capture --frame 100

The PLY file has the layout of 3DGS, which viewers of Gaussian splats read: metres, the hands at
rest unless a capture and a frame are named.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("avatar", type=Path, help="avatar folder")
    parser.add_argument("--ply", type=Path, required=True, metavar="FILE", help="file to write")
    parser.add_argument("--poses", type=Path, metavar="CAPTURE", help="capture to take a pose from")
    parser.add_argument("--frame", type=int, default=0, help="its frame (default: 0)")
    parser.add_argument(
        "--hand-model", metavar="MODEL", help="anny or mano:PATH (default: the avatar's own)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.capture import open_capture
    from wildghand.avatar.files import load_avatar
    from wildghand.avatar.ply import write_ply

    avatar = load_avatar(args.avatar, hand=args.hand_model)
    hands = avatar.rest_poses()
    if args.poses is not None:
        capture = open_capture(args.poses)
        poses = capture.hand_poses(args.frame)
        hands = {side: pose for side, pose in poses.items() if side in avatar.sides}
    posed = avatar.pose(hands)
    write_ply(args.ply, posed.means, posed.quats, posed.scales, posed.opacities, posed.colors)
    print(f"{args.ply}: {len(posed)} Gaussians")
    return 0
