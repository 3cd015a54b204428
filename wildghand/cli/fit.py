"""`wildghand fit` and `wildghand pretrain`."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hwp_bench.cli.options import overrides, print_json, say_next
from wildghand.cli.options import (
    add_address,
    add_ending,
    add_fitting,
    address_of,
)

if TYPE_CHECKING:
    from wildghand.fitting.parallel import World
    from wildghand.fitting.session import Watch
    from wildghand.from_video import MadeAvatar


@contextlib.contextmanager
def watching(args: argparse.Namespace, world: World) -> Iterator[tuple[Watch | None, Any]]:
    """Yield who is shown the fit and its import while the block runs: a page, TensorBoard."""
    from hwp_bench.base.console import notice
    from wildghand.fitting.tensorboard import logging_fit

    watch = glimpse = None
    with contextlib.ExitStack() as stack:
        if args.live and world.is_main:
            from wildghand.viewer.live import serve_fit

            served = stack.enter_context(serve_fit(address_of(args)))
            notice(f"The fit is shown at {served.url}")
            watch, glimpse = served.watch, served.glimpse
        log = args.tensorboard if world.is_main else None
        yield stack.enter_context(logging_fit(log, watch)), glimpse


_FIT_EXAMPLES = """examples:
  wildghand fit hand.mp4 -o my_hand
  wildghand fit hand.mp4 -o my_hand --quick
  wildghand fit sharp.mp4 -o my_hand --size 512
  wildghand fit my_capture -o my_avatar --budget 60
  wildghand fit my_capture -o my_avatar --live --port 9000
  wildghand fit my_capture -o paper --set mode=paper --set network.size=paper --set device=cuda
  torchrun --nproc-per-node 4 -m wildghand.cli.main fit my_capture -o my_avatar \\
      --set schedule.batch=4

A video of hands becomes an avatar folder with turntable.mp4 and sheet.jpg; what leads to them
is in its folder `work`. Tracking needs ai-edge-litert: pip install 'hwp-bench[track]'. A capture
is a folder (`hwp-bench data import video`, `hwp-bench sim render`). A stopped fit continues when
the same command is given again. With torchrun each process draws its part of every batch, on a
GPU of its own.
"""


def _add_fit(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _FIT_EXAMPLES
    add = parser.add_argument
    add("source", type=Path, metavar="VIDEO|CAPTURE", help="capture folder or video file")
    out = "avatar folder to make (default for a video: VIDEO_avatar)"
    add("-o", "--out", type=Path, help=out)
    quick = "fewer Gaussians and steps, and frames of a video: half of its time"
    add("--quick", action="store_true", help=quick)
    sides = "the hands in a video (default: auto, one or both, as it shows)"
    add("--side", choices=("auto", "right", "left"), help=sides)
    landmarks = "landmarks of a video (default: track them)"
    add("--landmarks", type=Path, metavar="NPZ", help=landmarks)
    networks = "the tracker's networks, as `data track` takes"
    add("--model", type=Path, metavar="FILE", help=networks)
    add("--hand-model", metavar="MODEL", help="for a video: anny (default) or mano:PATH")
    size = "of a video: edge of the frames that are fitted (default: 256; 512 for sharp videos)"
    add("--size", type=int, metavar="PX", help=size)
    add_fitting(parser, "optimizer steps")
    add("--budget", type=float, metavar="SECONDS", help="limit of the fit's time")
    frames = "fit all but the last twentieth (default: for a video yes, for a capture no)"
    add("--all-frames", action=argparse.BooleanOptionalAction, help=frames)
    prior = "start from it (made by `wildghand pretrain`; default: the one that ships)"
    add("--prior", type=Path, metavar="PRIOR", help=prior)
    live = "show the fit in the browser while it runs (needs viser); does not change it"
    add("--live", action="store_true", help=live)
    add_address(parser)
    log = "write curves of the fit for TensorBoard (needs tensorboard)"
    add("--tensorboard", type=Path, metavar="DIR", help=log)
    add_ending(parser, "avatar")


def _do_fit(args: argparse.Namespace) -> int:
    """Run the command, in one process or in those that torchrun started."""
    from hwp_bench.base.errors import UsageError
    from hwp_bench.base.files import check_places
    from wildghand.fitting.parallel import run_in_world
    from wildghand.from_video.make import folder_of, is_video
    from wildghand.gaussians.fit_loop import choose_device
    from wildghand.model.settings import read_settings
    from wildghand.viewer.server import Address

    if not args.live and address_of(args) != Address():
        raise UsageError(
            "is for --live", field="--host, --port", remedy="Give --live too, or leave it out."
        )
    inputs = {
        "VIDEO|CAPTURE": args.source,
        "--landmarks": args.landmarks,
        "--model": args.model,
        "--prior": args.prior,
    }
    check_places({"--out": args.out}, inputs, replaces=args.overwrite)
    outputs = {"--tensorboard": args.tensorboard, "--out": folder_of(args.source, args.out)}
    check_places(outputs, inputs)
    work = _video if is_video(args.source) else _capture
    return run_in_world(
        lambda: choose_device(read_settings(_settings(args)).device),
        lambda world: work(args, world),
    )


def _video(args: argparse.Namespace, world: World) -> int:
    from hwp_bench.base.console import notice
    from hwp_bench.importers.video import VideoImport
    from wildghand.from_video import VideoFit, make_avatar

    options = VideoFit(
        side=args.side or "auto",
        hand_model=args.hand_model or "anny",
        landmarks=args.landmarks,
        tracker=args.model,
        quick=args.quick,
        all_frames=args.all_frames is not False,
        size=VideoImport.size if args.size is None else args.size,
        steps=args.steps,
        seconds=args.budget,
        seed=args.seed,
        settings=_settings(args),
    )
    with watching(args, world) as (watch, glimpse):
        made = make_avatar(
            args.source,
            args.out,
            options,
            overwrite=args.overwrite,
            world=world,
            watch=watch,
            glimpse=glimpse,
        )
    if world.is_main:
        print_json(made.facts()) if args.json else _print(made)
        notice(f"next: open {made.facts()['page']} in a browser")
    return 0


def _print(made: MadeAvatar) -> None:
    facts = made.facts()
    hands = " and ".join(facts["hands"])
    print(f"{facts['avatar']}: {hands} hand, {facts['frames']} frames, {facts['steps']} steps")
    if "warning" in facts["video"]:
        print(f"video: {facts['video']['warning']}")
    for name in ("turntable", "sheet", "page"):
        print(f"{name}: {facts[name]}")
    verdict = made.verdict()
    for line in () if verdict is None else verdict.lines():
        print(line)
    took = ", ".join(f"{one['name']} {one['seconds']:.0f}" for one in facts["stages"])
    print(f"seconds: {took}")


def _capture(args: argparse.Namespace, world: World) -> int:
    from hwp_bench.base.errors import UsageError
    from hwp_bench.methods.contract import Budget
    from wildghand.fitting.session import fit_capture
    from wildghand.from_video.run import check_limits, with_quick

    for option in ("side", "landmarks", "model", "hand-model", "size"):
        if getattr(args, option.replace("-", "_")) is not None:
            raise UsageError(
                "is for videos; a capture says it itself", where=args.source, field=f"--{option}"
            )
    if args.out is None:
        raise UsageError("is missing", field="--out", remedy="Name the avatar folder to make.")
    check_limits(args.steps, args.budget, args.seed)
    with watching(args, world) as (watch, _):
        avatar = fit_capture(
            args.source,
            args.out,
            settings=with_quick(_settings(args), quick=args.quick),
            budget=Budget(seconds=args.budget, steps=args.steps),
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
        print_json({**facts, "hands": list(avatar.sides), "frames": len(record.frames)})
    else:
        hands = " and ".join(avatar.sides)
        print(
            f"{args.out}: {hands} hand, {len(record.frames)} frames, {record.steps} steps "
            f"in {record.seconds:.0f} s"
        )
    say_next("wildghand", "view", args.out, "--poses", args.source)
    say_next("wildghand", "page", args.out, "--poses", args.source)
    return 0


def _settings(args: argparse.Namespace) -> dict[str, Any]:
    """The overrides; a prior's path is the caller's, not the method's."""
    settings = overrides(args.set)
    if args.prior is not None:
        settings["prior"] = str(args.prior.resolve())
    return settings


_PRETRAIN_EXAMPLES = """examples:
  wildghand pretrain anna ben carl -o my_prior
  wildghand pretrain simulated/* -o my_prior --steps 6000
  wildghand fit dora -o dora_avatar --prior my_prior

Give captures of several people, one or more of each, and none that a score will be taken on. A
stopped run continues when the same command is given again.
"""


def _add_pretrain(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _PRETRAIN_EXAMPLES
    add = parser.add_argument
    add("captures", type=Path, nargs="+", metavar="CAPTURE", help="capture folder")
    add("-o", "--out", type=Path, required=True, help="prior to make, a folder")
    steps = "optimizer steps over all captures (default: those of a fit for each capture)"
    add_fitting(parser, steps)
    add_ending(parser, "prior")


def _do_pretrain(args: argparse.Namespace) -> int:
    from hwp_bench.base.files import check_places
    from wildghand.from_video.run import check_limits
    from wildghand.pretrain.pretrain import pretrain
    from wildghand.prior.prior import WEIGHTS

    check_places({"--out": args.out}, {"CAPTURE": args.captures}, replaces=args.overwrite)
    check_limits(args.steps, None, args.seed)
    record = pretrain(
        args.captures,
        args.out,
        settings=overrides(args.set),
        steps=args.steps,
        seed=args.seed,
        overwrite=args.overwrite,
    ).record
    size = (args.out / WEIGHTS).stat().st_size
    if args.json:
        facts = {"prior": str(args.out), "captures": len(record.captures), "steps": record.steps}
        print_json({**facts, "bytes": size, "weights": record.weights})
    else:
        print(
            f"{args.out}: {len(record.captures)} captures, {record.steps} steps, "
            f"{size / 1e6:.1f} MB"
        )
    return 0


#: What adds the arguments of a command, and what runs it and returns the status.
COMMANDS = {
    "fit": (_add_fit, _do_fit),
    "pretrain": (_add_pretrain, _do_pretrain),
}
