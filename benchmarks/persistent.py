"""Scores over the share of clean training frames, on the persistent suites: runs and figure.

Run from the repository: `python -m benchmarks.persistent -o runs/persistent`. Each method is
evaluated on each share as `hwp-bench evaluate` does it, into a results folder of its own:
`runs/persistent/METHOD/SUITE-seed0`. What is there already is not run again, so that the command
can be stopped, and given again with more methods, shares or seeds. Then all results that are there
are drawn: `clean-share.png`, `.svg`, and `tables/clean-share.*`, which
`hwp-bench table runs/persistent/*/* --by clean-share` prints too.

`--captures 0 3 4 7` takes some of the eight captures, whose results are then no suite's.
`--page docs/clean_share.md` also writes table and figure as a page.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hwp_bench.api import evaluate
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.base.tables import Table, to_markdown, write_tables
from hwp_bench.leaderboard.pages import with_digest
from hwp_bench.methods.manifest import find_method, read_manifest
from hwp_bench.report.clean_share import clean_share_table, write_clean_share
from hwp_bench.report.sources import find_captures
from hwp_bench.results import Results, read_all
from hwp_bench.sim.produce.capture import ensure_suite, suite

#: The methods by the names of their folders: where they are, and settings. The two baselines are
#: the best competitors of docs/field.md.
METHODS: Mapping[str, tuple[str, Mapping[str, Any]]] = MappingProxyType(
    {
        "default": ("wildghand", {}),
        "no-dpd": ("wildghand", {"dpd.enabled": False}),
        "no-pao": ("wildghand", {"pao.enabled": False}),
        "no-prepass": ("wildghand", {"prepass.enabled": False}),
        "released": ("wildghand", {"mode": "released"}),
        "plain": ("plain", {}),
        "occluder-splats": ("occluder-splats", {}),
        "trimmed": ("trimmed", {}),
    }
)
#: The suites by their share of clean training frames, in percent.
SHARES: Mapping[int, str] = MappingProxyType(
    {
        percent: "persistent" if percent == 10 else f"persistent-clean{percent}"
        for percent in (0, 10, 20, 35, 60)
    }
)
METRIC = "psnr"


def run(name: str, percent: int, seed: int, args: argparse.Namespace) -> Path:
    """Evaluate one method at one share, unless that is done; returns its results folder."""
    method, settings = METHODS[name]
    suite_name = SHARES[percent]
    out: Path = args.out / name / f"{suite_name}-seed{seed}"
    captures: Any = suite_name
    if args.captures:
        items = suite(suite_name)
        captures = ensure_suite([items[number] for number in args.captures])
    preset = read_manifest(find_method(method)).preset(None, suite_name)
    evaluate(
        method,
        captures,
        out=out,
        preset=preset,
        settings=settings,
        seed=seed,
        seconds=args.budget,
        steps=args.steps,
        jobs=args.jobs,
    )
    return out


def draw(out: Path, names: Sequence[str], page: Path | None = None) -> None:
    """Draw and print every result of a folder, methods in the order of `METHODS`.

    Args:
        page: Markdown file that also shows them, with a picture in `pictures` next to it.
    """
    folders = [
        file.parent for name in names for file in sorted((out / name).glob("*/results.json"))
    ]
    if not folders:
        raise UsageError("holds no results", where=out)
    results = read_all(folders)
    captures = find_captures(results)
    table = clean_share_table(results, captures, METRIC)
    write_tables(out / "tables", {"clean-share": table})
    write_clean_share(out, results, captures, METRIC)
    print(to_markdown(table))
    if page is not None:
        picture = page.parent / "pictures" / "clean-share.png"
        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.write_bytes((out / "clean-share.png").read_bytes())
        atomic_write(page, with_digest(_page(results, table)))


def _page(results: Sequence[Results], table: Table) -> str:
    """The page's Markdown."""
    facts = {
        "Captures": {capture.id for one in results for capture in one.captures},
        "Length of a fit": {_length(one.budget) for one in results},
        "Results of": {one.started[:10] for one in results},
        "Method digests": {one.method.digest[:12] for one in results},
        "Processor": {str(one.environment.get("processor", "unknown")) for one in results},
    }
    rows = [f"| {name} | {', '.join(sorted(values))} |" for name, values in facts.items()]
    return "\n".join(
        [
            "# Scores over the share of clean frames",
            "",
            "This page is written by `benchmarks/persistent.py` from result files. In its captures",
            "[perturbations last](simulation.md#persistent-perturbations). Equal steps are not",
            "equal seconds: [methods compared](field.md) have these.",
            "",
            "| | |",
            "| --- | --- |",
            *rows,
            "",
            "![Score of every method over the share of clean frames](pictures/clean-share.png)",
            "",
            to_markdown(table),
            "",
        ]
    )


def _length(budget: Mapping[str, Any]) -> str:
    """How long a fit of a budget is, in words."""
    if budget.get("seconds"):
        return f"{budget['seconds']:g} s"
    return f"{budget['steps']} steps" if budget.get("steps") else "the method's own"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    add = parser.add_argument
    add("-o", "--out", type=Path, required=True, metavar="DIR", help="folder of the results")
    add("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="methods (all)")
    add("--shares", nargs="+", type=int, choices=SHARES, default=list(SHARES), metavar="PERCENT")
    add("--captures", nargs="+", type=int, choices=range(8), metavar="N", help="captures (all)")
    add("--seeds", type=int, default=1, metavar="N", help="seeds 0 to N - 1 (1)")
    add("--steps", type=int, help="steps of a fit (the method's own)")
    add("--budget", type=float, metavar="SECONDS", help="seconds of a fit (no limit)")
    add("--jobs", type=int, default=1, help="captures at once (1)")
    add("--draw", action="store_true", help="only draw the results that are there")
    add("--page", type=Path, metavar="FILE", help="also write a Markdown page")
    args = parser.parse_args()
    if not args.draw:
        # Seed by seed and share by share, so that a command that is stopped leaves whole columns.
        for seed in range(args.seeds):
            for percent in args.shares:
                for name in args.methods:
                    run(name, percent, seed, args)
    draw(args.out, args.methods, args.page)


if __name__ == "__main__":
    main()
