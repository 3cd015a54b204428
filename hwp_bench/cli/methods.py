"""Commands for a method of one's own: `new` and `check-method`."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

from hwp_bench.base.errors import BadMethod, UsageError
from hwp_bench.base.tables import print_table
from hwp_bench.cli.data import print_findings
from hwp_bench.cli.evaluate import METHOD_HELP
from hwp_bench.cli.options import (
    SEVERAL,
    add_json,
    named_table,
    overrides,
    print_json,
    print_result,
    say_next,
)
from hwp_bench.taxonomy import SUITES

_KINDS = ("mean", "mesh", "torch", "command", "predictions")
_NEW = """examples:
  hwp-bench new my_method
  hwp-bench new my_method --kind torch
  hwp-bench new my_program --kind command
  hwp-bench new my_pictures --kind predictions

mean is a Python class that draws one colour, the least that runs; mesh one that draws the posed
mesh in the colours of the training frames; torch the same with colours that PyTorch fits in steps,
within a budget. command is a program of any language, and predictions are pictures that were drawn
elsewhere. Each of them runs as it is, and its files say what to replace.
"""
_CHECK = """examples:
  hwp-bench check-method my_method
  hwp-bench check-method my_method --set steps=50 --json
  hwp-bench check-method my_method --capture my_capture
  hwp-bench check-method my_pictures --suite smoke      # pictures that are there already

Runs the method as `evaluate` does, within 10 seconds and 200 steps, on 20 simulated frames of
64 px with two hands, which are rendered once. Looks at method.toml, at pictures (shape, type,
range, NaN, missing and damaged ones), at speed and memory, and at calls to the network, which an
evaluation does not have. Scores are not looked at.
Exit status 0: nothing is wrong (there may be warnings); 1: something is; 2: the command line is.
"""


def _add_new(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _NEW
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="folder to make; its name is the method's")
    add("--kind", choices=_KINDS, default="mean", help="what to begin with (default mean)")
    add_json(parser, "print the files as JSON")


def _new(args: argparse.Namespace) -> int:
    from hwp_bench.methods.template import write_method

    files = [str(file) for file in write_method(args.folder, args.kind)]
    print_result(args.json, files, files)
    if args.kind == "predictions":
        say_next("hwp-bench", "data", "inputs", "--suite", "smoke", "-o", "inputs")
        say_next("python", args.folder / "draw.py", "inputs/requests")
        say_next("hwp-bench", "check-method", args.folder, "--suite", "smoke")
    else:
        say_next("hwp-bench", "check-method", args.folder)
    return 0


def _add_check(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _CHECK
    add = parser.add_argument
    add("method", metavar="METHOD", help=METHOD_HELP)
    where = parser.add_mutually_exclusive_group()
    text = "captures of a suite in place of the toy capture"
    where.add_argument("--suite", choices=SUITES, help=text)
    text = "capture folders in place of it"
    where.add_argument("--capture", **SEVERAL, metavar="PATH", help=text)
    add("--preset", help="preset of the method (default: smoke, if it has one)")
    text = "override one setting of the preset; may be given again"
    add("--set", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "limit of the fit's time (default 10)"
    add("--budget", type=float, default=10.0, metavar="SECONDS", help=text)
    text = "further files and folders that the method may read, such as weights"
    add("--expose", **SEVERAL, metavar="PATH", help=text)
    add(
        "--isolation", choices=("auto", "required", "none"), default="auto", help="as in `evaluate`"
    )
    add_json(parser, "print the report as JSON")


def _check(args: argparse.Namespace) -> int:
    from hwp_bench.commitments.publication import open_captures
    from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
    from hwp_bench.evaluation.check_method import BUDGET, TIME_LIMIT, check_method, toy_capture
    from hwp_bench.methods.contract import RunSettings
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.run.sandbox.confinement import Confinement
    from hwp_bench.suites.suite import ensure_suite

    if not 0 < args.budget < float("inf"):
        raise UsageError(f"{args.budget} is not above 0", field="--budget")
    budget = replace(BUDGET, seconds=args.budget)
    settings = EvaluationSettings(
        suite=args.suite or "smoke",
        preset=args.preset,
        run=RunSettings(overrides(args.set), budget=budget),
        time_limit=TIME_LIMIT + args.budget,
        confinement=Confinement(args.isolation, exposed=tuple(map(Path, args.expose))),
    )
    root = find_method(args.method)
    if args.suite:
        folders = ensure_suite(args.suite)
    elif args.capture:
        folders = [Path(path) for path in args.capture]
    else:
        kind = ""
        with suppress(BadMethod):
            # A wrong method.toml is for the report.
            kind = read_manifest(root).kind
        if kind == "predictions":
            raise UsageError(
                "holds pictures that were drawn before, and none of the toy capture",
                where=root,
                remedy="Say of which captures they are: --suite SUITE or --capture PATH.",
            )
        folders = [toy_capture()]
    report = check_method(root, open_captures(folders, None), settings)
    if args.json:
        print_json({"ok": report.ok, **asdict(report)})
    else:
        if report.facts:
            rows = [(name, *facts.values()) for name, facts in report.facts.items()]
            titles = ", ".join(["capture", *next(iter(report.facts.values()))])
            print_table(named_table(f"{report.path}: what a run takes", titles, rows))
        errors = sum(finding.level == "error" for finding in report.findings)
        print(f"{report.path}: {f'{errors} things wrong' if errors else 'nothing wrong'}")
        print_findings(report.findings)
    if report.ok:
        suite = ["--suite", args.suite or "smoke"]
        where = ["--capture", *args.capture] if args.capture else suite
        say_next("hwp-bench", "evaluate", args.method, *where)
    return 0 if report.ok else 1


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {"new": (_add_new, _new), "check-method": (_add_check, _check)}
