"""`hwp-bench sim`: list, plan, render, preview and calibrate simulated captures."""

from __future__ import annotations

import argparse

from hwp_bench.cli.options import add_actions, add_json
from hwp_bench.run.engine.options import add_engine_arguments
from hwp_bench.taxonomy import SIMULATED_SUITES

_EXAMPLES = """examples:
  hwp-bench sim list
  hwp-bench sim plan capture4 --frames 60 --size 176
  hwp-bench sim render --suite mini
  hwp-bench sim render capture0 -o my_capture --frames 60 --size 160 --severity 3
  hwp-bench sim render all -o captures --subject 7
  hwp-bench sim render persistent-2 -o none_clean --frames 60 --size 176 --clean-share 0
  hwp-bench sim preview wild-dev-3 -o preview
  hwp-bench sim render --suite full --engine ray://10.0.0.1:6379 --job-cpus 8
  hwp-bench sim preview capture5 -o preview
  hwp-bench sim calibrate my_scene.toml --write

A scene is the name of one of the eleven captures, of a scene of wild-dev, wild-test or persistent
such as wild-dev-3, or the path of a scene file. `all` are the eleven captures, wild-dev all of its
own.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    action = add_actions(parser)
    add_json(action("list", "list scenes, suites, objects and effects"))
    scenes = "scene names, files, all, or wild-dev, wild-test, persistent"

    plan = action("plan", "print what a scene's frames need and will cost")
    plan.add_argument("scene", metavar="SCENE", nargs="+", help=scenes)
    _add_extent(plan)
    _add_clean_share(plan)
    text = "count passes only, render no probe for the cost"
    plan.add_argument("--no-probe", action="store_true", help=text)
    add_json(plan)

    render = action("render", "render captures")
    add, text = render.add_argument, "scene name or file, all, or wild-dev, wild-test, persistent"
    add("scene", metavar="SCENE", nargs="?", help=text)
    add("-o", "--out", help="folder to make; for all and for suites their parent")
    add("--suite", choices=SIMULATED_SUITES, help="render a suite")
    _add_extent(render)
    _add_variation(render)
    add("--seed", type=int, help="another seed of everything random")
    add("--workers", type=int, help="processes (default: as many as are worth it)")
    add("--exr", action="store_true", help="also linear EXR with extra layers")
    text = "without the clip of unseen poses from cameras all around"
    add("--no-free-view", dest="free_view", action="store_false", help=text)
    add("--overwrite", action="store_true", help="replace what exists")
    add_engine_arguments(render)

    preview = action("preview", "contact sheet and animation of a scene")
    add = preview.add_argument
    add("scene", metavar="SCENE", help="scene name or file")
    add("-o", "--out", default=".", help="folder (default: here)")
    add("--frames", type=int, default=48, help="frames (default 48)")
    add("--size", type=int, default=160, help="edge in pixels (default 160)")
    _add_variation(preview)
    text = "draw hand, objects, light and camera in 3D instead"
    add("--stage", action="store_true", help=text)

    calibrate = action("calibrate", "solve strengths for stated losses")
    add = calibrate.add_argument
    add("scene", metavar="SCENE", nargs="+", help=scenes)
    add("--effect", metavar="KIND", help="only this effect")
    add("--write", action="store_true", help="write strengths into the files")
    add_json(calibrate)


def _add_extent(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=int, help="frames (default: the scene's own)")
    parser.add_argument("--size", type=int, help="edge of the image in pixels (default 256)")


def _add_clean_share(parser: argparse.ArgumentParser) -> None:
    text = "share of the training part in which no effect acts, 0-0.9: stretches the episodes"
    parser.add_argument("--clean-share", type=float, metavar="SHARE", help=text)


def _add_variation(parser: argparse.ArgumentParser) -> None:
    severity = "one severity, 1-5, for every episode"
    _add_clean_share(parser)
    parser.add_argument("--severity", type=float, help=severity)
    parser.add_argument("--subject", type=int, metavar="SEED", help="another person")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.sim.produce import commands

    action = {
        "list": commands.list_scenes,
        "plan": commands.print_plan,
        "render": commands.render,
        "preview": commands.preview,
        "calibrate": commands.calibrate_scenes,
    }[args.action]
    return action(args)
