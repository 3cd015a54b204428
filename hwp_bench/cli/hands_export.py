"""`hwp-bench hands export`."""

from __future__ import annotations

import argparse
from pathlib import Path

_EXAMPLES = """examples:
  hwp-bench hands export my_capture hand.glb              # the estimated hands of frame 0
  hwp-bench hands export my_capture hand.obj --frame 12
  hwp-bench hands export simulated hand.ply --frame 12 --truth

The ending of the file says the format: .glb, .obj, .ply or .stl. Coordinates are in m, in the
world of the cameras.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Write the posed hand meshes of one frame for other programs."
    parser.epilog = _EXAMPLES
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="capture folder")
    parser.add_argument("out", type=Path, metavar="FILE", help="mesh file to write")
    parser.add_argument("--frame", type=int, default=0, help="index of the frame (default 0)")
    parser.add_argument(
        "--truth", action="store_true", help="the true hands of a simulated capture"
    )


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.files import check_places
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.convert import hand_meshes, write_meshes

    check_places({"FILE": args.out}, {"CAPTURE": args.capture})
    meshes = hand_meshes(open_capture(args.capture), args.frame, truth=args.truth)
    path = write_meshes(meshes, args.out)
    count = sum(len(mesh.vertices) for mesh in meshes.values())
    print(f"{path}: {' and '.join(meshes)} hand, {count} vertices")
    return 0
