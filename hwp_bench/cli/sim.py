"""`hwp-bench sim` and `hwp-bench dev`: render, preview, plan and calibrate simulated captures."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import check_places
from hwp_bench.cli.options import add_json, add_overwrite, print_json, say_next
from hwp_bench.run.engine.options import add_engine_arguments
from hwp_bench.taxonomy import SIMULATED_SUITES

if TYPE_CHECKING:
    from hwp_bench.sim.scene.scene import Scene

_RENDER = """examples:
  hwp-bench sim render --suite mini
  hwp-bench sim render capture0 -o my_capture --frame-count 60 --size 160 --severity 3
  hwp-bench sim render all -o captures --subject 7
  hwp-bench sim render persistent-2 -o none_clean --frame-count 60 --size 176 --clean-share 0
  hwp-bench sim render --suite full --engine ray://10.0.0.1:6379 --job-cpus 8

A scene is the name of one of the eleven captures, of a scene of wild-dev, wild-test or persistent
such as wild-dev-3, or the path of a scene file. `all` are the eleven captures, wild-dev all of its
own. `hwp-bench list scenes` names them.
"""
_PREVIEW = """examples:
  hwp-bench sim preview capture5 -o preview
  hwp-bench sim preview wild-dev-3 -o preview --severity 4
  hwp-bench sim preview capture5 -o preview --stage
"""
_PLAN = """examples:
  hwp-bench dev plan capture4 --frame-count 60 --size 176
  hwp-bench dev plan wild-dev --no-probe --json
"""
_CALIBRATE = """examples:
  hwp-bench dev calibrate my_scene.toml
  hwp-bench dev calibrate my_scene.toml --effect motion_blur --write
"""
_SCENES = "scene names, files, all, or wild-dev, wild-test, persistent"


def _add_plan(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _PLAN
    parser.add_argument("scene", metavar="SCENE", nargs="+", help=_SCENES)
    _add_extent(parser)
    _add_clean_share(parser)
    text = "count passes only, render no probe for the cost"
    parser.add_argument("--no-probe", action="store_true", help=text)
    add_json(parser)


def _add_render(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _RENDER
    add, text = parser.add_argument, "scene name or file, all, or wild-dev, wild-test, persistent"
    add("scene", metavar="SCENE", nargs="?", help=text)
    add("-o", "--out", help="folder to make; for all and for suites their parent")
    add("--suite", choices=SIMULATED_SUITES, help="render a suite")
    _add_extent(parser)
    _add_variation(parser)
    add("--seed", type=int, help="another seed of all random numbers")
    add("--workers", type=int, help="processes of each render (default: as many as help)")
    add("--exr", action="store_true", help="also linear EXR with extra layers")
    text = "without the clip of unseen poses from cameras all around"
    add("--no-free-view", dest="free_view", action="store_false", help=text)
    add_overwrite(parser, "captures that exist")
    add_engine_arguments(parser)


def _add_preview(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _PREVIEW
    add = parser.add_argument
    add("scene", metavar="SCENE", help="scene name or file")
    add("-o", "--out", default=".", help="folder (default: here)")
    add("--frame-count", type=int, metavar="N", help="frames (default 48)")
    add("--size", type=int, help="edge in pixels (default 160)")
    _add_variation(parser)
    text = "draw hand, objects, light and camera in 3D instead"
    add("--stage", action="store_true", help=text)


def _add_calibrate(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _CALIBRATE
    add = parser.add_argument
    add("scene", metavar="SCENE", nargs="+", help=_SCENES)
    add("--effect", metavar="KIND", help="only this effect")
    add("--write", action="store_true", help="write strengths into the files")
    add_json(parser)


def _add_extent(parser: argparse.ArgumentParser) -> None:
    text = "frames (default: the scene's own)"
    parser.add_argument("--frame-count", type=int, metavar="N", help=text)
    parser.add_argument("--size", type=int, help="edge of the image in pixels (default 256)")


def _add_clean_share(parser: argparse.ArgumentParser) -> None:
    text = "share of the training part in which no effect acts, 0-0.9: stretches the episodes"
    parser.add_argument("--clean-share", type=float, metavar="SHARE", help=text)


def _add_variation(parser: argparse.ArgumentParser) -> None:
    severity = "one severity, 1-5, for every episode"
    _add_clean_share(parser)
    parser.add_argument("--severity", type=float, help=severity)
    parser.add_argument("--subject", type=int, metavar="SEED", help="another person")


def _plan(args: argparse.Namespace) -> int:
    """Print passes and predicted cost."""
    from hwp_bench.base.console import print_document
    from hwp_bench.base.tables import to_markdown
    from hwp_bench.sim.produce.forecast import forecast, plan_table, share_table
    from hwp_bench.sim.produce.truth import distances, subject_table

    scenes = [_changed(scene, args.clean_share) for scene in _scenes(args.scene)]
    reports = [
        forecast(scene, args.frame_count, args.size, probe=not args.no_probe) for scene in scenes
    ]
    off = {scene.id: hands for scene in scenes if (hands := distances(scene))}
    if args.json:
        rows = [asdict(report) for report in reports]
        for row in rows:
            for side, item in off.get(row["scene"], {}).items():
                row.setdefault("subject", {})[side] = asdict(item)
        print_json(rows)
    else:
        tables = [plan_table(reports)] + ([] if args.no_probe else [share_table(reports)])
        tables += [subject_table(off)] if off else []
        print_document("\n".join(to_markdown(table) for table in tables))
    return 0


def _render(args: argparse.Namespace) -> int:
    """Render captures and print their folders."""
    from hwp_bench.base.records import whole_seed
    from hwp_bench.capture.folder import refuse_taken
    from hwp_bench.run.engine.options import engine_for, needs_of
    from hwp_bench.sim.produce.capture import RenderRequest, ensure_suite, workers_each

    if args.seed is not None:
        whole_seed(args.seed, "--seed")
    if (args.suite is None) == (args.scene is None):
        raise UsageError("give a scene, all, or a suite with --suite")
    changes = (
        *(args.frame_count, args.size, args.severity, args.subject, args.seed),
        args.clean_share,
    )
    if args.suite is not None:
        if any(change is not None for change in changes) or args.exr:
            raise UsageError("a suite is rendered as it is", field="--suite")
        if args.overwrite:
            raise UsageError(
                "captures of a suite that are whole are kept",
                field="--overwrite",
                remedy="Remove the folder of the capture, whose name the command prints.",
            )
        check_places({"--out": args.out}, {})
        with engine_for(args) as engine:
            folders = ensure_suite(
                args.suite,
                args.out,
                args.workers,
                engine=engine,
                needs=needs_of(args),
                free_view=args.free_view,
            )
        for folder in folders:
            print(folder)
        return 0
    if args.out is None:
        raise UsageError("is missing", field="-o", remedy="Give a folder with -o.")
    scenes = [
        _changed(scene, args.clean_share, args.severity, args.subject)
        for scene in _scenes([args.scene])
    ]
    named = Path(args.scene)
    check_places(
        {"--out": args.out},
        {"SCENE": named if named.is_file() else None},
        replaces=args.overwrite,
        makes_captures=len(scenes) == 1,
    )
    jobs, needs = [], needs_of(args)
    with engine_for(args) as engine:
        for scene in scenes:
            out = Path(args.out) / scene.id if len(scenes) > 1 else Path(args.out)
            refuse_taken(out, overwrite=args.overwrite)
            request = RenderRequest(
                scene,
                args.frame_count,
                args.size,
                args.seed,
                workers=workers_each(args.workers, engine, needs),
                exr=args.exr,
                overwrite=args.overwrite,
                free_view=args.free_view,
            )
            jobs.append(request.job(out, needs))
        engine.run(jobs, lambda index: None)
    for job in jobs:
        print(job.output)
    say_next("hwp-bench", "evaluate", "plain", "--capture", *(job.output for job in jobs))
    return 0


def _preview(args: argparse.Namespace) -> int:
    """Write a contact sheet and an animation, or the stage in 3D."""
    check_places({"--out": args.out}, {})
    from hwp_bench.sim.scene_files import load_scene

    given = {"frame_count": args.frame_count, "size": args.size}
    given = {name: value for name, value in given.items() if value is not None}
    if args.stage and given:
        raise UsageError("are of the sheet, not of --stage", field="--frame-count, --size")
    scene = _changed(load_scene(args.scene), args.clean_share, args.severity, args.subject)
    if args.stage:
        from hwp_bench.sim.produce.preview import draw_stage

        print(draw_stage(scene, Path(args.out)))
        return 0
    from hwp_bench.sim.produce.preview import write_preview

    for path in write_preview(scene, Path(args.out), **given):
        print(path)
    return 0


def _calibrate(args: argparse.Namespace) -> int:
    """Solve strengths, print them with what was measured, and write them if asked."""
    from hwp_bench.sim.produce.calibration import calibrate, write_strengths
    from hwp_bench.sim.scene_files import known_scenes, load_scene, meant_scenes, scene_path

    rows: list[dict[str, Any]] = []
    for name in meant_scenes(args.scene):
        scene = load_scene(name)
        calls = [call for call in scene.effects if args.effect in (None, call.kind)]
        results = [calibrate(scene, call) for call in calls]
        if args.write:
            path = scene_path(name) if name in known_scenes() else Path(name)
            write_strengths(path, results)
            # By its path, since a scene that ships is read once.
            scene = load_scene(str(path))
        for item in results:
            row = asdict(item)
            rows.append(
                {"scene": scene.id, "digest": scene.digest, "effect": row.pop("kind"), **row}
            )
            if not args.json:
                measured = " ".join(f"{value:7.3f}" for value in item.measured)
                target = " ".join(f"{value:7.3f}" for value in item.targets)
                print(f"{scene.id} {item.kind} ({item.measure}): {measured}  target {target}")
    if not rows:
        problem = "none of these scenes has " + (args.effect or "an effect")
        raise UsageError(problem, field="--effect" if args.effect else "SCENE")
    if args.json:
        print_json(rows)
    return 0


def _scenes(names: list[str]) -> list[Scene]:
    from hwp_bench.sim.scene_files import load_scene, meant_scenes

    return [load_scene(name) for name in meant_scenes(names)]


def _changed(
    scene: Scene,
    share: float | None,
    severity: float | None = None,
    subject: int | None = None,
) -> Scene:
    from hwp_bench.sim.scene.scene import with_clean_share, with_severity, with_subject

    if severity is not None:
        scene = with_severity(scene, severity)
    # After the severity: ends of mild episodes are clean.
    if share is not None:
        scene = with_clean_share(scene, share)
    if subject is not None:
        scene = with_subject(scene, subject)
    return scene


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "render": (_add_render, _render),
    "preview": (_add_preview, _preview),
    "plan": (_add_plan, _plan),
    "calibrate": (_add_calibrate, _calibrate),
}
