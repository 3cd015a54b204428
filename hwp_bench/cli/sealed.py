"""`hwp-bench sealed`."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import check_places
from hwp_bench.cli.options import add_actions, add_json, print_json, print_result
from hwp_bench.run.engine.options import add_engine_arguments, engine_for, needs_of
from hwp_bench.taxonomy import SIMULATED_SUITES

if TYPE_CHECKING:
    from hwp_bench.commitments import SealedRecipe

_EXAMPLES = """examples:
  hwp-bench sealed make --suite mini -o exam                      # the organiser
  hwp-bench evaluate submission --sealed exam/publication/sealed  # ... scores a submission
  hwp-bench sealed reveal exam -o revealed.json                   # ... when all are scored
  hwp-bench sealed check exam/publication/public revealed.json    # anybody, then

The scenes of the suites are public, so that a method which brings its own copy of the simulator can
draw their test frames. In a sealed suite every person and every seed follow from a secret.
docs/submissions.md says who publishes what, and when.
"""
_MAKE = """examples:
  hwp-bench sealed make --suite mini -o exam
  hwp-bench sealed make capture0 capture4 wild-test-2 --frames 60 --size 176 -o exam
  hwp-bench sealed make --suite full-lite -o exam --engine ray://10.0.0.1:6379 --job-cpus 8

exam/publication/public goes to authors; publish exam/publication/public/suite.json before anybody
submits, because it binds you. exam/keeper holds the secret and the captures, and
exam/publication/sealed the test frames: keep both. A start that was stopped continues.
"""
_REVEAL = """examples:
  hwp-bench sealed reveal exam -o revealed.json

Publishes nothing by itself: it writes the file that you publish. Afterwards the suite is as public
as any other.
"""
_CHECK = """examples:
  hwp-bench sealed check public revealed.json
  hwp-bench sealed check public revealed.json --capture sealed-capture0   # one of them
  hwp-bench sealed check public revealed.json --no-render                 # the commitments alone

Renders every capture again from the secret, in the folder of --work, and compares training frames
and the commitments to test frames. Exit status 0: all is as committed to; 1: the secret is another
one, or a capture differs (on another kind of machine the simulator may round otherwise: --json says
by how many levels).
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    action = add_actions(parser)
    text = "draw a secret, render a suite from it, divide it into parts"
    make = action("make", text, _make, _MAKE)
    reveal = action("reveal", "write the file that reveals a suite's secret", _reveal, _REVEAL)
    text = "make the captures of a revealed suite again and compare"
    check = action("check", text, _check, _CHECK)
    workers = "processes (default: as many as are worth it)"

    add = make.add_argument
    add("scenes", nargs="*", metavar="SCENE", help="scenes that come along")
    add("--suite", choices=SIMULATED_SUITES, help="the scenes, frames and size of a suite")
    add("-o", "--out", required=True, metavar="DIR", help="folder of the suite")
    add("--frames", type=int, help="frames of each capture (default 60)")
    add("--size", type=int, help="edge of the images in pixels (default 176)")
    add("--secret", metavar="FILE", help="file of a secret (default: draw one)")
    add("--workers", type=int, help=workers)
    add_json(make, "print what was made as JSON")
    add_engine_arguments(make)

    reveal.add_argument("suite", metavar="SUITE", help="folder that `make` made")
    reveal.add_argument("-o", "--out", required=True, metavar="FILE", help="file to write")

    add = check.add_argument
    add("public", metavar="PUBLIC", help="the published part for authors")
    add("revealed", metavar="REVEALED", help="the file that reveals the secret")
    add("--work", default="revealed-captures", metavar="DIR", help="folder of the new captures")
    which, text = check.add_mutually_exclusive_group(), "captures to make again (default: all)"
    which.add_argument("--capture", nargs="+", action="extend", metavar="ID", help=text)
    which.add_argument("--no-render", action="store_true", help="compare the commitments alone")
    add("--workers", type=int, help=workers)
    add_json(check, "print what was compared as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    status: int = args.act(args)
    return status


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
    return print_result(args.json, value, [f"{name}: {text}" for name, text in facts.items()])


def _recipe(args: argparse.Namespace) -> SealedRecipe:
    from hwp_bench.commitments.recipe import recipe_of, suite_recipe

    if (args.suite is None) == (not args.scenes):
        raise UsageError("give scenes, or a suite with --suite")
    if args.suite is not None:
        if args.frames is not None or args.size is not None:
            raise UsageError("has its own frames and size", field="--suite")
        return suite_recipe(args.suite)
    return recipe_of(args.scenes, args.frames or 60, args.size or 176)


def _reveal(args: argparse.Namespace) -> int:
    from hwp_bench.commitments import reveal

    check_places({"--out": args.out}, {"SUITE": args.suite})
    reveal(args.suite, args.out)
    print(Path(args.out))
    return 0


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
        print(f"{capture.id}: {text}")
    return status
