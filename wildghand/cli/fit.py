"""`wildghand fit`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wildghand.cli.serving import add_address, watching

if TYPE_CHECKING:
    from wildghand.fitting.parallel import World

_EXAMPLES = """examples:
  wildghand fit my_capture -o my_avatar
  wildghand fit my_capture -o my_avatar --seconds 60
  wildghand fit my_capture -o my_avatar --live --port 9000
  wildghand fit hand.mp4 --landmarks hand.npz -o my_avatar
  wildghand fit my_capture -o paper --set mode=paper --set network.size=paper --set device=cuda
  torchrun --nproc-per-node 4 -m wildghand.cli.main fit my_capture -o my_avatar \\
      --set schedule.batch=4

With torchrun each process draws its part of every batch, on a GPU of its own.
A capture is a folder (`hwp-bench data import-video`, `hwp-bench sim render`). A video becomes one
first, next to the avatar. A stopped fit goes on when the same command is given again.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("source", type=Path, metavar="CAPTURE|VIDEO", help="what to fit")
    parser.add_argument("-o", "--out", type=Path, required=True, help="avatar folder to make")
    parser.add_argument("--landmarks", type=Path, metavar="NPZ", help="landmarks of a video")
    parser.add_argument(
        "--side",
        choices=("right", "left"),
        help="the hand in a video (default: as the landmarks say, else right)",
    )
    parser.add_argument(
        "--hand", default="anny", metavar="MODEL", help="hand model for a video: anny or mano:PATH"
    )
    parser.add_argument("--steps", type=int, help="optimizer steps")
    parser.add_argument("--seconds", type=float, help="most seconds of fitting")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default: 0)")
    parser.add_argument(
        "--all-frames", action="store_true", help="fit validation and test frames too"
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
    from wildghand.fitting.parallel import run_in_world
    from wildghand.gaussians.fit_loop import choose_device
    from wildghand.model.settings import read_settings

    return run_in_world(
        lambda: choose_device(read_settings(_settings(args)).device),
        lambda world: _run(args, world),
    )


def _run(args: argparse.Namespace, world: World) -> int:
    from hwp_bench.base.errors import UsageError
    from hwp_bench.methods.contract import Budget
    from wildghand.fitting.session import fit_capture

    if args.steps is not None and args.steps < 1:
        raise UsageError(f"is {args.steps}", field="--steps", remedy="Use 1 or more.")
    if args.seconds is not None and not args.seconds > 0.0:
        raise UsageError(f"is {args.seconds}", field="--seconds", remedy="Use more than 0.")
    if args.seed < 0:
        raise UsageError(f"is {args.seed}", field="--seed", remedy="Use 0 or more.")
    with watching(args, shown=args.live and world.is_main) as watch:
        avatar = fit_capture(
            _shared_capture(args, world),
            args.out,
            settings=_settings(args),
            budget=Budget(seconds=args.seconds, steps=args.steps),
            seed=args.seed,
            all_frames=args.all_frames,
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
    from hwp_bench.cli.overrides import overrides

    settings = overrides(args.set)
    if args.prior is not None:
        settings["prior"] = str(args.prior.resolve())
    return settings


def _shared_capture(args: argparse.Namespace, world: World) -> Path:
    """The capture folder; rank 0 makes it where there is none yet."""
    if not world.is_main:
        world.wait_for_main()
        return _capture(args)
    folder = _capture(args)
    world.wait_for_main()
    return folder


def _capture(args: argparse.Namespace) -> Path:
    """The capture folder; made of a video where the source is one."""
    from hwp_bench.base.errors import UsageError

    if args.source.is_dir() or not args.source.exists():
        return args.source
    if args.landmarks is None:
        raise UsageError(
            "is a file; a video needs the landmarks that a tracker found in it",
            where=args.source,
            field="--landmarks",
            remedy="`hwp-bench data track VIDEO` makes them.",
        )
    from hwp_bench.importers.shared.hand_tracks import tracked_side
    from hwp_bench.importers.video import VideoImport, import_video

    folder = args.out.with_name(args.out.name + ".capture")
    if not folder.is_dir():
        import_video(
            args.source,
            args.landmarks,
            folder,
            VideoImport(hand=args.side or tracked_side(args.landmarks), hand_model=args.hand),
        )
    return folder
