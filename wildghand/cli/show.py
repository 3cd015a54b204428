"""Commands that show an avatar: `render`, `view`, `export`, `page`."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import check_places, refuse_existing_file
from hwp_bench.cli.options import add_json, print_json
from wildghand.cli.options import (
    add_address,
    add_avatar,
    add_ending,
    add_poses,
    address_of,
    avatar_of,
)

_RENDER_EXAMPLES = """examples:
  wildghand render my_avatar --poses my_capture -o frames
  wildghand render my_avatar --poses other_capture -o frames --range 100:200 --background 255
  wildghand render my_avatar --poses my_capture -o frames --video turn.mp4
  wildghand render my_avatar --poses my_capture -o frames --overwrite   # in place of older frames

The poses are those of a capture: its hand parameters and cameras. PNG files are named by frame.
"""


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _RENDER_EXAMPLES
    add = parser.add_argument
    add_avatar(parser)
    add_poses(parser, "capture to take poses from", required=True)
    add("-o", "--out", type=Path, required=True, help="folder of images to make")
    add("--range", metavar="A:B", help="frames A to B-1 only")
    add("--background", type=int, default=0, metavar="GREY", help="0 black to 255 white")
    add("--video", type=Path, metavar="MP4", help="also write a video")
    add_ending(parser, "folder or video")


def _do_render(args: argparse.Namespace) -> int:
    from hwp_bench.capture import open_capture
    from wildghand.avatar.render import render_clip

    if not 0 <= args.background <= 255:
        raise UsageError(f"is {args.background}", field="--background", remedy="Use 0 to 255.")
    inputs = {"AVATAR": args.avatar, "--poses": args.poses}
    check_places({"--out": args.out, "--video": args.video}, inputs, replaces=args.overwrite)
    avatar, capture = avatar_of(args), open_capture(args.poses)
    frames = _frames(args.range, capture.info.frame_count)
    choices = {name: getattr(args, name) for name in ("background", "video", "overwrite")}
    facts = render_clip(avatar, capture, frames, args.out, **choices)
    if args.json:
        print_json(facts)
    else:
        print(f"{args.out}: {facts['frames']} frames, {facts['frames_per_second']:.1f} a second")
    return 0


def _frames(text: str | None, count: int) -> range:
    if text is None:
        return range(count)
    first, colon, last = text.partition(":")
    try:
        start, stop = int(first or 0), int(last or count) if colon else int(first) + 1
    except ValueError:
        start = stop = -1
    if not 0 <= start < stop <= count:
        problem = f"{text!r} is not a part of {count} frames"
        raise UsageError(problem, field="--range", remedy="Use A:B, as 0:10.")
    return range(start, stop)


_VIEW_EXAMPLES = """examples:
  wildghand view my_avatar
  wildghand view my_avatar --poses my_capture
  wildghand view my_avatar --port 9000 --background 40 40 40

Prints the address of a page and serves it until Ctrl-C. In the page the hand is turned with the
mouse, and posed with sliders in degrees, with named poses, or by the motion of a capture. The page
is for this machine only; --host 0.0.0.0 shows it to everybody who reaches the machine. It needs
viser: pip install 'hwp-bench[view]'.
"""


def _add_view(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _VIEW_EXAMPLES
    add = parser.add_argument
    add_avatar(parser)
    add_poses(
        parser,
        "capture whose motion is played (default: the one that the avatar was made of, where "
        "it lies with the avatar)",
    )
    add_address(parser)
    add("--size", type=int, default=1024, metavar="PX", help="largest edge of a picture")
    text = "colour behind the hand, 0 to 255 each (default: white)"
    white, names = (255, 255, 255), ("R", "G", "B")
    add("--background", type=int, nargs=3, default=white, metavar=names, help=text)
    add_json(parser)


def _do_view(args: argparse.Namespace) -> int:
    """Run the command; Ctrl-C ends it with status 0."""
    import threading

    from hwp_bench.capture import open_capture
    from wildghand.viewer.posed_view import Motion, capture_of
    from wildghand.viewer.server import require_viser
    from wildghand.viewer.view import ViewSettings, serve_view

    red, green, blue = args.background
    settings = ViewSettings(args.size, (red, green, blue))
    require_viser()
    avatar, poses = avatar_of(args), args.poses or capture_of(args.avatar)
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


_EXPORT_EXAMPLES = """examples:
  wildghand export my_avatar -o hand.ply
  wildghand export my_avatar -o hand.spz --poses my_capture --frame 100
  wildghand export my_avatar -o hand.ply --supersplat
  wildghand export my_avatar -o splats.glb
  wildghand export my_avatar -o hand.glb --mesh --poses my_capture
  wildghand export frame649.pth -o hand.ply      # Gaussians that the authors' code has made

The extension decides the format: .ply, Gaussians in the layout of 3DGS; .spz, the same in a tenth
of the size; .glb, Gaussians as glTF (KHR_gaussian_splatting), or with --mesh a skinned mesh with 16
joints a hand, a texture and a motion. Lengths are metres. In place of an avatar's folder a file
(.pth, .ckpt) may stand with the Gaussians of one pose, as the authors' code makes them;
docs/export.md says how it is saved.
"""


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EXPORT_EXAMPLES
    add = parser.add_argument
    add_avatar(parser)
    add("-o", "--out", type=Path, required=True, metavar="FILE", help="file to write")
    mesh = "a skinned mesh instead of Gaussians (.glb)"
    add("--mesh", action="store_true", help=mesh)
    add_poses(parser, "capture to take a pose or a motion from")
    add("--frame", type=int, help="its frame, for Gaussians (default: 0)")
    scale = "units of the file in a metre (default: 1)"
    add("--scale", type=float, default=1.0, help=scale)
    turned = "for SuperSplat: opens upright, palm to the viewer, ten units in a metre (.ply)"
    add("--supersplat", action="store_true", help=turned)
    degree = (
        "how strongly colours of Gaussians may depend on the view, 0 to 3 "
        "(default: 3; 0: one colour each, and a third of the size)"
    )
    add("--harmonics", type=int, metavar="DEGREE", help=degree)
    texels = "edge of a mesh's texture (default: 1024)"
    add("--texture", type=int, metavar="TEXELS", help=texels)
    add_ending(parser, "file")


def _do_export(args: argparse.Namespace) -> int:
    from wildghand.export.formats import ExportSettings, check_target, export, export_gaussians

    names = (item.name for item in dataclasses.fields(ExportSettings))
    settings = ExportSettings(**{name: getattr(args, name) for name in names})
    check_places({"--out": args.out}, {"AVATAR": args.avatar, "--poses": args.poses})
    check_target(args.out, settings, overwrite=args.overwrite)
    if args.frame is not None and (args.poses is None or args.mesh):
        raise UsageError("needs --poses, and no --mesh", field="--frame")

    counts: dict[str, int]
    if args.avatar.is_file():
        for option, given in (("--poses", args.poses), ("--hand-model", args.hand_model)):
            if given is not None:
                raise UsageError("needs an avatar, not Gaussians of one pose", field=option)
        from wildghand.export.official import read_official_gaussians

        splats = read_official_gaussians(args.avatar)
        counts = export_gaussians(splats, args.out, settings, overwrite=args.overwrite)
    else:
        from hwp_bench.capture import open_capture

        capture = None if args.poses is None else open_capture(args.poses)
        more: dict[str, Any] = {"frame": args.frame, "overwrite": args.overwrite}
        counts = export(avatar_of(args), args.out, settings, capture=capture, **more)
    if args.json:
        print_json({"file": str(args.out), **counts})
    else:
        print(f"{args.out}: " + ", ".join(f"{count} {name}" for name, count in counts.items()))
    return 0


_STAGE_EXAMPLES = """examples:
  wildghand stage my_avatar --poses my_capture
  wildghand stage my_avatar --poses my_capture --frame 30 -o side.png

Draws the Gaussians of one frame as ellipsoids and the cameras of the clip in 3D, seen from the
side: the camera of the frame is red, others are grey. It needs no display.
"""


def _add_stage(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _STAGE_EXAMPLES
    add_avatar(parser)
    add_poses(parser, "capture with the pose and the cameras (default: what a fit of a video left)")
    add, out = parser.add_argument, Path("stage.png")
    add("--frame", type=int, default=0, help="its frame (default: 0)")
    text = "image to write (default: stage.png)"
    add("-o", "--out", type=Path, default=out, metavar="FILE", help=text)
    add_ending(parser, "file")


def _do_stage(args: argparse.Namespace) -> int:
    from hwp_bench.capture import open_capture
    from wildghand.viewer.posed_view import capture_of
    from wildghand.viewer.stage import draw_stage

    check_places({"--out": args.out}, {"AVATAR": args.avatar, "--poses": args.poses})
    if args.out.suffix.lower() not in (".png", ".jpg"):
        raise UsageError("has another ending than .png or .jpg", where=args.out, field="--out")
    refuse_existing_file(args.out, overwrite=args.overwrite)
    poses = args.poses or capture_of(args.avatar)
    if poses is None:
        raise UsageError("is missing", field="--poses", remedy="Name the capture that was fitted.")
    count = draw_stage(avatar_of(args), open_capture(poses), args.frame, args.out)
    if args.json:
        print_json({"file": str(args.out), "gaussians": count})
    else:
        print(f"{args.out}: {count} Gaussians")
    return 0


_PAGE_EXAMPLES = """examples:
  wildghand page my_avatar
  wildghand page my_avatar --poses my_capture -o hand.html

Writes one HTML file that works offline in a browser with WebGL2: the hand can be turned and posed.
With the capture that was fitted its motion is played, too.
"""


def _add_page(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _PAGE_EXAMPLES
    add_avatar(parser)
    out, text = Path("avatar.html"), "file to write (default: avatar.html)"
    parser.add_argument("-o", "--out", type=Path, default=out, metavar="FILE", help=text)
    add_poses(
        parser, "capture that was fitted, for its motion (default: what a fit of a video left)"
    )
    add_ending(parser, "file")


def _do_page(args: argparse.Namespace) -> int:
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
        print_json(dataclasses.asdict(facts))
        return 0
    print(f"{args.out}: {facts.gaussians} Gaussians, {facts.bytes / 1e6:.2f} MB")
    return 0


#: What adds the arguments of a command, and what runs it and returns the status.
COMMANDS = {
    "render": (_add_render, _do_render),
    "view": (_add_view, _do_view),
    "export": (_add_export, _do_export),
    "page": (_add_page, _do_page),
    "stage": (_add_stage, _do_stage),
}
