"""The actions of `hwp-bench sim`."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import check_places
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.scene_files import known_scenes, load_scene, meant_scenes, scene_path

if TYPE_CHECKING:
    pass


def list_scenes(args: argparse.Namespace) -> int:
    """Print the scenes, and what scenes can be made of."""
    from hwp_bench.hands.poses import gestures
    from hwp_bench.sim.effects import ORDER
    from hwp_bench.sim.produce.capture import suite, suite_names
    from hwp_bench.sim.props.behind import backdrop_names
    from hwp_bench.sim.props.objects import object_names

    scenes = [load_scene(name) for name in known_scenes()]
    suites = {name: [item.scene.id for item in suite(name)] for name in suite_names()}
    parts = {
        "suites": suites,
        "effects": list(ORDER),
        "objects": list(object_names()),
        "gestures": list(gestures()),
        "backgrounds": list(backdrop_names()),
    }
    if args.json:
        rows = [
            {
                "id": scene.id,
                "title": scene.title,
                "hands": scene.hands,
                "action": scene.action,
                "device": scene.device,
                "frame_count": scene.frame_count,
                "effects": [call.kind for call in scene.effects],
                "digest": scene.digest,
            }
            for scene in scenes
        ]
        print(json.dumps({"scenes": rows, **parts}, indent=1))
        return 0
    for scene in scenes:
        effects = ", ".join(call.kind for call in scene.effects)
        print(f"{scene.id:<11} {scene.frame_count:>5} frames  {scene.title} ({effects})")
    for name, ids in suites.items():
        print(f"suite {name}: {', '.join(ids)}")
    for name in ("objects", "gestures", "backgrounds"):
        print(f"{name}: {', '.join(parts[name])}")
    return 0


def print_plan(args: argparse.Namespace) -> int:
    """Print passes and predicted cost."""
    from hwp_bench.base.console import print_document
    from hwp_bench.base.tables import to_markdown
    from hwp_bench.sim.produce.forecast import forecast, plan_table, share_table
    from hwp_bench.sim.produce.truth import distances, subject_table

    scenes = [_changed(scene, args.clean_share) for scene in _scenes(args.scene)]
    reports = [forecast(scene, args.frames, args.size, probe=not args.no_probe) for scene in scenes]
    off = {scene.id: hands for scene in scenes if (hands := distances(scene))}
    if args.json:
        rows = [asdict(report) for report in reports]
        for row in rows:
            for side, item in off.get(row["scene"], {}).items():
                row.setdefault("subject", {})[side] = asdict(item)
        print(json.dumps(rows, indent=1))
    else:
        tables = [plan_table(reports)] + ([] if args.no_probe else [share_table(reports)])
        tables += [subject_table(off)] if off else []
        print_document("\n".join(to_markdown(table) for table in tables))
    return 0


def render(args: argparse.Namespace) -> int:
    """Render captures and print their folders."""
    from hwp_bench.run.engine.options import engine_for, needs_of
    from hwp_bench.sim.produce.capture import RenderRequest, ensure_suite, workers_each

    if (args.suite is None) == (args.scene is None):
        raise UsageError("give a scene, all, or a suite with --suite")
    changes = (
        *(args.frames, args.size, args.severity, args.subject, args.seed),
        args.clean_share,
    )
    if args.suite is not None:
        if any(change is not None for change in changes) or args.exr:
            raise UsageError("a suite is rendered as it is", field="--suite")
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
    if args.seed is not None and args.seed < 0:
        raise UsageError(f"is {args.seed}", field="--seed", remedy="Use 0 or more.")
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
            if not args.overwrite and (out.is_file() or (out.is_dir() and any(out.iterdir()))):
                remedy = "Choose another place or --overwrite."
                raise UsageError("exists already", where=out, remedy=remedy)
            request = RenderRequest(
                scene,
                args.frames,
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
    return 0


def preview(args: argparse.Namespace) -> int:
    """Write a contact sheet and an animation, or the stage in 3D."""
    check_places({"--out": args.out}, {})
    scene = _changed(load_scene(args.scene), args.clean_share, args.severity, args.subject)
    if args.stage:
        from hwp_bench.sim.produce.preview import draw_stage

        print(draw_stage(scene, Path(args.out)))
        return 0
    from hwp_bench.sim.produce.preview import write_preview

    for path in write_preview(scene, Path(args.out), frame_count=args.frames, size=args.size):
        print(path)
    return 0


def calibrate_scenes(args: argparse.Namespace) -> int:
    """Solve strengths, print them with what was measured, and write them if asked."""
    from hwp_bench.sim.produce.calibration import calibrate, write_strengths

    rows: list[dict[str, Any]] = []
    for name in meant_scenes(args.scene):
        scene = load_scene(name)
        calls = [call for call in scene.effects if args.effect in (None, call.kind)]
        results = [calibrate(scene, call) for call in calls]
        if args.write:
            write_strengths(scene_path(name) if name in known_scenes() else Path(name), results)
        digest = load_scene(name).digest if args.write else scene.digest
        for item in results:
            row = asdict(item)
            rows.append({"scene": scene.id, "digest": digest, "effect": row.pop("kind"), **row})
            if not args.json:
                measured = " ".join(f"{value:7.3f}" for value in item.measured)
                target = " ".join(f"{value:7.3f}" for value in item.targets)
                print(f"{scene.id} {item.kind} ({item.measure}): {measured}  target {target}")
    if args.json:
        print(json.dumps(rows, indent=1))
    return 0


def _scenes(names: list[str]) -> list[Scene]:
    return [load_scene(name) for name in meant_scenes(names)]


def _changed(
    scene: Scene,
    share: float | None,
    severity: float | None = None,
    subject: int | None = None,
) -> Scene:
    from hwp_bench.sim.scene.scene import with_clean_share, with_severity, with_subject

    if share is not None:
        scene = with_clean_share(scene, share)
    if severity is not None:
        scene = with_severity(scene, severity)
    if subject is not None:
        scene = with_subject(scene, subject)
    return scene
