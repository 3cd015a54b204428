"""`hwp-bench sim`: list, plan, render, preview and calibrate simulated captures."""

from __future__ import annotations

import argparse

from hwp_bench.cli.options import add_actions, add_json
from hwp_bench.run.engine.options import add_engine_arguments
from hwp_bench.taxonomy import SUITES

_EXAMPLES = """examples:
  hwp-bench sim list
  hwp-bench sim plan capture4 --frames 60 --size 176
  hwp-bench sim render --suite mini
  hwp-bench sim render capture0 -o my_capture --frames 60 --size 160 --severity 3
  hwp-bench sim render all -o captures --subject 7
  hwp-bench sim preview wild-dev-3 -o preview
  hwp-bench sim render --suite full --engine ray://10.0.0.1:6379 --job-cpus 8
  hwp-bench sim preview capture5 -o preview
  hwp-bench sim calibrate my_scene.toml --write

A scene is the name of one of the eleven captures, of a scene of wild-dev or wild-test such as
wild-dev-3, or the path of a scene file. `all` are the eleven captures, wild-dev all of its own.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    action = add_actions(parser)
    _add_list(action("list", "list scenes, suites, objects and effects"))
    _add_plan(action("plan", "print what a scene's frames need and will cost"))
    _add_render(action("render", "render captures"))
    _add_preview(action("preview", "contact sheet and animation of a scene"))
    _add_gallery(action("gallery", "images for the documentation"))
    _add_calibrate(action("calibrate", "solve strengths for stated losses"))


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.sim.produce import commands

    action = {
        "list": commands.list_scenes,
        "plan": commands.print_plan,
        "render": commands.render,
        "preview": commands.preview,
        "gallery": commands.gallery,
        "calibrate": commands.calibrate_scenes,
    }[args.action]
    return action(args)


def _add_list(parser: argparse.ArgumentParser) -> None:
    add_json(parser)


def _add_plan(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scene", metavar="SCENE", nargs="+", help="scene names, files, all, or a wild suite"
    )
    _add_extent(parser)
    parser.add_argument(
        "--no-probe", action="store_true", help="count passes only, render no probe for the cost"
    )
    add_json(parser)


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scene", metavar="SCENE", nargs="?", help="scene name or file, all, or a wild suite"
    )
    parser.add_argument("-o", "--out", help="folder to make; for all and for suites their parent")
    parser.add_argument("--suite", choices=SUITES, help="render a suite")
    _add_extent(parser)
    parser.add_argument("--severity", type=float, help="one severity, 1-5, for every episode")
    parser.add_argument("--subject", type=int, metavar="SEED", help="another person")
    parser.add_argument("--seed", type=int, help="another seed of everything random")
    parser.add_argument("--workers", type=int, help="processes (default: as many as are worth it)")
    parser.add_argument("--exr", action="store_true", help="also linear EXR with extra layers")
    parser.add_argument(
        "--no-free-view",
        dest="free_view",
        action="store_false",
        help="without the clip of unseen poses from cameras all around",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace what exists")
    add_engine_arguments(parser)


def _add_preview(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="scene name or file")
    parser.add_argument("-o", "--out", default=".", help="folder (default: here)")
    parser.add_argument("--frames", type=int, default=48, help="frames (default 48)")
    parser.add_argument("--size", type=int, default=160, help="edge in pixels (default 160)")
    parser.add_argument("--severity", type=float, help="one severity, 1-5, for every episode")
    parser.add_argument("--subject", type=int, metavar="SEED", help="another person")
    parser.add_argument(
        "--stage", action="store_true", help="draw hand, objects, light and camera in 3D instead"
    )


def _add_gallery(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--out", default="docs/pictures/sim", help="folder")


def _add_calibrate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scene", metavar="SCENE", nargs="+", help="scene names, files, all, or a wild suite"
    )
    parser.add_argument("--effect", metavar="KIND", help="only this effect")
    parser.add_argument("--write", action="store_true", help="write strengths into the files")
    add_json(parser)


def _add_extent(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=int, help="frames (default: the scene's own)")
    parser.add_argument("--size", type=int, help="edge of the image in pixels (default 256)")
