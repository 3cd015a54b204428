"""`wildghand fit`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wildghand.cli.serving import add_address, watching

if TYPE_CHECKING:
    from wildghand.fitting.parallel import World
    from wildghand.from_video import MadeAvatar

_EXAMPLES = """examples:
  wildghand fit hand.mp4 -o my_hand
  wildghand fit hand.mp4 -o my_hand --quick
  wildghand fit my_capture -o my_avatar --seconds 60
  wildghand fit my_capture -o my_avatar --live --port 9000
  wildghand fit my_capture -o paper --set mode=paper --set network.size=paper --set device=cuda
  torchrun --nproc-per-node 4 -m wildghand.cli.main fit my_capture -o my_avatar \\
      --set schedule.batch=4

A video of hands becomes an avatar folder with turntable.mp4 and sheet.jpg; what leads to them
is in its folder `work`. Tracking needs ai-edge-litert: pip install 'hwp-bench[track]'. A capture
is a folder (`hwp-bench data import-video`, `hwp-bench sim render`). A stopped fit goes on when
the same command is given again. With torchrun each process draws its part of every batch, on a
GPU of its own.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("source", type=Path, metavar="VIDEO|CAPTURE", help="what to fit")
    parser.add_argument(
        "-o", "--out", type=Path, help="avatar folder to make (default for a video: VIDEO_avatar)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="a third of the time: fewer frames, Gaussians, steps"
    )
    parser.add_argument(
        "--side",
        choices=("auto", "right", "left"),
        help="the hands in a video (default: auto, one or both, as it shows)",
    )
    parser.add_argument(
        "--landmarks", type=Path, metavar="NPZ", help="landmarks of a video (default: track them)"
    )
    parser.add_argument(
        "--model", type=Path, metavar="FILE", help="the tracker's networks, as `data track` takes"
    )
    parser.add_argument(
        "--hand-model", metavar="MODEL", help="for a video: anny (default) or mano:PATH"
    )
    parser.add_argument("--steps", type=int, help="optimizer steps")
    parser.add_argument("--seconds", type=float, help="most seconds of optimizing")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
    parser.add_argument(
        "--all-frames",
        action=argparse.BooleanOptionalAction,
        help="fit validation and test frames too (default: for a video yes, for a capture no)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting, as schedule.batch=4 (wildghand/model/settings.py); may be repeated",
    )
    parser.add_argument(
        "--prior",
        type=Path,
        metavar="PRIOR",
        help="start from it (made by `wildghand pretrain`; default: the one that ships)",
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="show the fit in the browser while it runs (needs viser); changes nothing of it",
    )
    add_address(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing avatar")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command, in one process or in those that torchrun started."""
    from hwp_bench.base.files import check_places
    from wildghand.fitting.parallel import run_in_world
    from wildghand.from_video.api import is_video
    from wildghand.gaussians.fit_loop import choose_device
    from wildghand.model.settings import read_settings

    inputs = {
        "VIDEO|CAPTURE": args.source,
        "--landmarks": args.landmarks,
        "--model": args.model,
        "--prior": args.prior,
    }
    check_places({"--out": args.out}, inputs, replaces=args.overwrite)
    work = _video if is_video(args.source) else _capture
    return run_in_world(
        lambda: choose_device(read_settings(_settings(args)).device),
        lambda world: work(args, world),
    )


def _video(args: argparse.Namespace, world: World) -> int:
    from wildghand.from_video import VideoFit, make_avatar

    options = VideoFit(
        side=args.side or "auto",
        hand_model=args.hand_model or "anny",
        landmarks=args.landmarks,
        tracker=args.model,
        quick=args.quick,
        all_frames=args.all_frames is not False,
        steps=args.steps,
        seconds=args.seconds,
        seed=args.seed,
        settings=_settings(args),
    )
    with watching(args, shown=args.live and world.is_main) as watch:
        made = make_avatar(
            args.source, args.out, options, overwrite=args.overwrite, world=world, watch=watch
        )
    if world.is_main:
        print(json.dumps(made.facts(), indent=1)) if args.json else _print(made)
    return 0


def _print(made: MadeAvatar) -> None:
    facts = made.facts()
    hands = " and ".join(facts["hands"])
    print(f"{facts['avatar']}: {hands} hand, {facts['frames']} frames, {facts['steps']} steps")
    if "warning" in facts["video"]:
        print(f"video: {facts['video']['warning']}")
    print(f"turntable: {facts['turntable']}")
    print(f"sheet: {facts['sheet']}")
    print(f"page: {facts['page']}")
    took = ", ".join(f"{one['name']} {one['seconds']:.0f}" for one in facts["stages"])
    print(f"seconds: {took}")


def _capture(args: argparse.Namespace, world: World) -> int:
    from hwp_bench.base.errors import UsageError
    from hwp_bench.methods.contract import Budget
    from wildghand.fitting.session import fit_capture
    from wildghand.from_video.settings import with_quick

    for option in ("side", "landmarks", "model", "hand-model"):
        if getattr(args, option.replace("-", "_")) is not None:
            raise UsageError(
                "is for videos; a capture says it itself", where=args.source, field=f"--{option}"
            )
    if args.out is None:
        raise UsageError("is missing", field="--out", remedy="Name the avatar folder to make.")
    if args.steps is not None and args.steps < 1:
        raise UsageError(f"is {args.steps}", field="--steps", remedy="Use 1 or more.")
    if args.seconds is not None and not args.seconds > 0.0:
        raise UsageError(f"is {args.seconds}", field="--seconds", remedy="Use more than 0.")
    if args.seed < 0:
        raise UsageError(f"is {args.seed}", field="--seed", remedy="Use 0 or more.")
    with watching(args, shown=args.live and world.is_main) as watch:
        avatar = fit_capture(
            args.source,
            args.out,
            settings=with_quick(_settings(args), quick=args.quick),
            budget=Budget(seconds=args.seconds, steps=args.steps),
            seed=args.seed,
            all_frames=args.all_frames is True,
            overwrite=args.overwrite,
            world=world,
            watch=watch,
        )
    if not world.is_main:
        return 0
    record = avatar.record
    if args.json:
        facts = {"avatar": str(args.out), "steps": record.steps, "seconds": record.seconds}
        print(json.dumps({**facts, "hands": list(avatar.sides), "frames": len(record.frames)}))
    else:
        hands = " and ".join(avatar.sides)
        print(
            f"{args.out}: {hands} hand, {len(record.frames)} frames, {record.steps} steps "
            f"in {record.seconds:.0f} s"
        )
    return 0


def _settings(args: argparse.Namespace) -> dict[str, Any]:
    """The overrides; a prior's path is the caller's, not the method's."""
    from hwp_bench.cli.options import overrides

    settings = overrides(args.set)
    if args.prior is not None:
        settings["prior"] = str(args.prior.resolve())
    return settings
