"""`hwp-bench challenge`."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import check_places
from hwp_bench.cli.options import (
    add_json,
    add_out,
    add_splits,
    print_json,
    print_result,
    say_next,
    splits_of,
)
from hwp_bench.run.engine.options import add_engine_arguments, engine_for, needs_of
from hwp_bench.taxonomy import SIMULATED_SUITES

if TYPE_CHECKING:
    from hwp_bench.commitments import SealedRecipe

_MAKE = """examples:
  hwp-bench challenge make --suite mini -o exam
  hwp-bench challenge make capture0 capture4 wild-test-2 --frame-count 60 --size 176 -o exam
  hwp-bench challenge make --suite full-lite -o exam --engine ray://10.0.0.1:6379 --job-cpus 8

The scenes of the suites are public, so that a method which brings its own copy of the simulator can
draw their test frames. In a sealed suite every person and every seed follow from a secret.
docs/challenge.md says who publishes what, and when.
exam/publication/public goes to authors; publish exam/publication/public/suite.json before anybody
submits, because it binds you. exam/keeper holds the secret and the captures, and
exam/publication/sealed the test frames: keep both. A start that was stopped continues.
"""
_REVEAL = """examples:
  hwp-bench challenge reveal exam -o revealed.json

Publishes nothing by itself: it writes the file that you publish. Afterwards the suite is as public
as any other.
"""
_CHECK = """examples:
  hwp-bench challenge check public revealed.json
  hwp-bench challenge check public revealed.json --capture sealed-capture0   # one of them
  hwp-bench challenge check public revealed.json --no-render                 # the commitments alone

Renders every capture again from the secret, in the folder of --work, and compares training frames,
hand parameters, cameras, split and the commitments to test frames. Exit status 0: all is as
committed to; 1: the secret is another one, or a capture differs (on another kind of machine the
simulator may round otherwise: --json says by how many levels).
"""


_WORKERS = "processes of each render (default: as many as help)"


def _add_make(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _MAKE
    add = parser.add_argument
    add("scenes", nargs="*", metavar="SCENE", help="names of scenes, in place of a suite")
    add("--suite", choices=SIMULATED_SUITES, help="the scenes, frames and size of a suite")
    add_out(parser, "folder of the suite")
    add("--frame-count", type=int, metavar="N", help="frames of each capture (default 60)")
    add("--size", type=int, help="edge of the images in pixels (default 176)")
    add("--secret", metavar="FILE", help="file of a secret (default: draw one)")
    add("--workers", type=int, help=_WORKERS)
    add_json(parser, "print what was made as JSON")
    add_engine_arguments(parser)


def _make(args: argparse.Namespace) -> int:
    from hwp_bench.commitments import make_suite
    from hwp_bench.commitments.recipe import read_secret

    check_places({"--out": args.out}, {"--secret": args.secret})
    recipe = _recipe(args)
    secret = read_secret(args.secret) if args.secret else None
    with engine_for(args) as engine:
        made = make_suite(
            args.out,
            recipe,
            secret=secret,
            workers=args.workers,
            engine=engine,
            needs=needs_of(args),
        )
    facts = {
        "for authors": str(made.public),
        "keep secret": str(made.sealed),
        "the secret": str(made.secret),
        "commitment to the secret": made.page.secret_commitment,
        "commitment to the frames": made.page.frames_commitment,
    }
    value = {name.replace(" ", "_"): text for name, text in facts.items()}
    say_next("hwp-bench", "evaluate", "SUBMISSION", "--sealed", made.sealed)
    return print_result(args.json, value, [f"{name}: {text}" for name, text in facts.items()])


def _recipe(args: argparse.Namespace) -> SealedRecipe:
    from hwp_bench.commitments.recipe import recipe_of, suite_recipe

    if (args.suite is None) == (not args.scenes):
        raise UsageError("give scenes, or a suite with --suite")
    if args.suite is not None:
        if args.frame_count is not None or args.size is not None:
            raise UsageError("has its own frames and size", field="--suite")
        return suite_recipe(args.suite)
    frames = 60 if args.frame_count is None else args.frame_count
    return recipe_of(args.scenes, frames, 176 if args.size is None else args.size)


def _add_reveal(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _REVEAL
    parser.add_argument("suite", metavar="SUITE", help="folder that `challenge make` made")
    add_out(parser, "file to write", "FILE")


def _reveal(args: argparse.Namespace) -> int:
    from hwp_bench.commitments import reveal

    check_places({"--out": args.out}, {"SUITE": args.suite})
    reveal(args.suite, args.out)
    print(Path(args.out))
    return 0


def _add_check(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _CHECK
    add = parser.add_argument
    add("public", metavar="PUBLIC", help="the published part for authors")
    add("revealed", metavar="REVEALED", help="the file that reveals the secret")
    add("--work", default="revealed-captures", metavar="DIR", help="folder of the new captures")
    which, text = parser.add_mutually_exclusive_group(), "captures to make again (default: all)"
    which.add_argument("--capture", nargs="+", action="extend", metavar="ID", help=text)
    which.add_argument("--no-render", action="store_true", help="compare the commitments alone")
    add("--workers", type=int, help=_WORKERS)
    add_json(parser, "print what was compared as JSON")


def _check(args: argparse.Namespace) -> int:
    from hwp_bench.commitments import check_revealed

    check_places({"--work": args.work}, {"PUBLIC": args.public, "REVEALED": args.revealed})
    only = () if args.no_render else args.capture
    found = check_revealed(args.public, args.revealed, args.work, only=only, workers=args.workers)
    status = 0 if found.holds else 1
    if args.json:
        rows = [{**asdict(capture), "same": capture.same} for capture in found.captures]
        page = {"secret_commitment": found.page.secret_commitment, "holds": found.holds}
        print_json({**page, "captures": rows})
        return status
    print(f"the secret is the one that was committed to: {found.page.secret_commitment}")
    for capture in found.captures:
        text = "as committed to"
        if not capture.same:
            hidden = "as committed to" if capture.hidden else "others than committed to"
            text = (
                f"differs: test frames {hidden}, {capture.different} training images "
                f"differ by at most {capture.levels} of 255"
            )
            if not capture.numbers:
                text += ", hand parameters, cameras or the split differ"
        print(f"{capture.id}: {text}")
    return status


_PUBLISH = """examples:
  hwp-bench challenge publish captures/* -o publication
  hwp-bench challenge publish captures/* -o publication --splits splits/mine.json
  hwp-bench evaluate submission/ --sealed publication/sealed

publication/public goes to authors: training and validation frames, and the hand parameters and
cameras of every frame. publication/sealed stays with the keeper: it holds the test frames, and the
salt of the commitment that the public manifest carries.
"""


def _add_publish(parser: argparse.ArgumentParser) -> None:
    parser.description = "Divide captures into a public and a sealed part."
    parser.epilog = _PUBLISH
    captures = "capture folders"
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURES", help=captures)
    add_out(parser, "folder to make")
    add_splits(parser)
    add_json(parser, "print what was written as JSON")


def _publish(args: argparse.Namespace) -> int:
    from hwp_bench.commitments import publish

    check_places({"--out": args.out}, {"CAPTURES": args.captures, "--splits": args.splits})
    made = publish(args.captures, args.out, splits=splits_of(args))
    value = {
        "public": str(made.public),
        "sealed": str(made.sealed),
        "commitment": made.commitment,
        "captures": list(made.captures),
    }
    lines = (
        f"captures: {', '.join(made.captures)}",
        f"for authors: {made.public}",
        f"keep secret: {made.sealed}",
        f"commitment: {made.commitment}",
    )
    return print_result(args.json, value, lines)


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "make": (_add_make, _make),
    "publish": (_add_publish, _publish),
    "reveal": (_add_reveal, _reveal),
    "check": (_add_check, _check),
}
