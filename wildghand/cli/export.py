"""`wildghand export`."""

from __future__ import annotations

import argparse
from pathlib import Path

_EXAMPLES = """examples:
  wildghand export my_avatar -o hand.ply
  wildghand export my_avatar -o hand.spz --poses my_capture --frame 100
  wildghand export my_avatar -o hand.ply --supersplat
  wildghand export my_avatar -o splats.glb
  wildghand export my_avatar -o hand.glb --mesh --poses my_capture

The extension decides the format: .ply, Gaussians in the layout of 3DGS; .spz, the same in a tenth
of the size; .glb, Gaussians as glTF (KHR_gaussian_splatting, a release candidate), or with --mesh
a skinned mesh with 16 joints a hand, a texture and a motion. Lengths are metres.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("avatar", type=Path, help="avatar folder")
    parser.add_argument(
        *("-o", "--out"), type=Path, required=True, metavar="FILE", help="file to write"
    )
    parser.add_argument(
        "--mesh", action="store_true", help="a skinned mesh instead of Gaussians (.glb)"
    )
    parser.add_argument(
        "--poses", type=Path, metavar="CAPTURE", help="capture to take a pose or a motion from"
    )
    parser.add_argument("--frame", type=int, help="its frame, for Gaussians (default: 0)")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="units of the file in a metre (default: 1)"
    )
    parser.add_argument(
        "--supersplat",
        action="store_true",
        help="for SuperSplat: opens upright, palm to the viewer, ten units in a metre (.ply)",
    )
    parser.add_argument(
        "--harmonics",
        type=int,
        default=3,
        metavar="DEGREE",
        help="how finely colours of Gaussians change with the side they are seen from, 0 to 3 "
        "(default: 3; 0: one colour each, and a third of the size)",
    )
    parser.add_argument(
        "--texture",
        type=int,
        default=1024,
        metavar="TEXELS",
        help="edge of a mesh's texture (default: 1024)",
    )
    parser.add_argument(
        "--hand-model", metavar="MODEL", help="anny or mano:PATH (default: the avatar's own)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace what exists")
    parser.add_argument("--json", action="store_true", help="print counts as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.errors import UsageError
    from hwp_bench.base.files import check_places
    from wildghand.export.formats import ExportSettings, check_target, export

    settings = ExportSettings(
        mesh=args.mesh,
        scale=args.scale,
        supersplat=args.supersplat,
        harmonics=args.harmonics,
        texture=args.texture,
    )
    check_places({"--out": args.out}, {"AVATAR": args.avatar, "--poses": args.poses})
    check_target(args.out, settings, overwrite=args.overwrite)
    if args.frame is not None and (args.poses is None or args.mesh):
        raise UsageError("needs --poses, and no --mesh", field="--frame")

    import json

    from hwp_bench.capture import open_capture
    from wildghand.avatar.files import load_avatar

    capture = None if args.poses is None else open_capture(args.poses)
    avatar = load_avatar(args.avatar, hand=args.hand_model)
    counts = export(
        avatar, args.out, settings, capture=capture, frame=args.frame, overwrite=args.overwrite
    )
    if args.json:
        print(json.dumps({"file": str(args.out), **counts}))
    else:
        print(f"{args.out}: " + ", ".join(f"{count} {name}" for name, count in counts.items()))
    return 0
