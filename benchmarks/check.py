"""Whether what the benchmarks measure still keeps the ratios that are stored.

Run from the repository: `python -m benchmarks.check [--quick] [--only NAME...]`. It exits with
status 1 where a ratio is worse than the stored one by more than its tolerance. A ratio compares two
things in one run, so that it means the same on a slow machine; a benchmark of which one is worse is
measured again, up to three times in all, and the best of each counts, so that other work on the
machine does not look like a regression. `--update` stores what is measured now. The ratios are in
`benchmarks/ratios.json`; `--list` prints them and measures nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.ratio_store import STORE, Benchmark, read_store, updated, write_store
from hwp_bench.base.console import notice
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.base.tables import Column, Table, print_table

#: Measurements of a benchmark before a ratio counts as worse.
MEASUREMENTS = 3


def best_of(benchmark: Benchmark, measurements: int = MEASUREMENTS) -> dict[str, float]:
    """Measure a benchmark, again while one of its ratios is worse than it may be.

    Returns:
        The best value of each stored ratio; a ratio that the benchmark no longer measures is
        missing.
    """
    best: dict[str, float] = {}
    for _ in range(measurements):
        found = benchmark.measure()
        for ratio in benchmark.ratios:
            if ratio.name in found:
                values = [best.get(ratio.name, found[ratio.name]), found[ratio.name]]
                best[ratio.name] = min(values) if ratio.better == "lower" else max(values)
        if not benchmark.regressions(best):
            break
    return best


def chosen(benchmarks: Sequence[Benchmark], only: Sequence[str], quick: bool) -> list[Benchmark]:
    """The benchmarks that are asked for.

    Raises:
        UsageError: there is none of a name.
    """
    names = [benchmark.name for benchmark in benchmarks]
    unknown = sorted(set(only) - set(names))
    if unknown:
        raise UsageError(
            f"there is not a benchmark {unknown[0]!r}",
            field="--only",
            remedy=f"Known: {', '.join(names)}.",
        )
    return [
        benchmark
        for benchmark in benchmarks
        if (not only or benchmark.name in only) and (benchmark.quick or not quick)
    ]


def table_of(
    benchmarks: Sequence[Benchmark], found: Mapping[str, Mapping[str, float]] | None
) -> Table:
    """Stored ratios, and next to them the measured ones where there are any."""
    rows = []
    for benchmark in benchmarks:
        bounds = benchmark.bounds()
        worse = benchmark.regressions({} if found is None else found[benchmark.name])
        for ratio in benchmark.ratios:
            bound = ("≤ " if ratio.better == "lower" else "≥ ") + f"{bounds[ratio.name]:.2f}"
            row = [benchmark.name, ratio.name, ratio.ratio, bound]
            if found is None:
                row += ["yes" if benchmark.quick else "no", benchmark.machine, benchmark.command]
            else:
                row.append(found[benchmark.name].get(ratio.name))
                row.append("WORSE" if ratio.name in worse else "kept")
            rows.append(tuple(row))
    titles = ["benchmark", "ratio", "stored", "allowed"]
    titles += ["quick", "machine", "command"] if found is None else ["now", ""]
    return Table("Ratios", tuple(Column(title) for title in titles), tuple(rows), ranked=False)


def as_json(
    benchmarks: Sequence[Benchmark], found: Mapping[str, Mapping[str, float]]
) -> list[dict[str, object]]:
    """What was found, for programs."""
    return [
        {
            "benchmark": benchmark.name,
            "ratio": ratio.name,
            "stored": ratio.ratio,
            "allowed": benchmark.bounds()[ratio.name],
            "better": ratio.better,
            "now": found[benchmark.name].get(ratio.name),
            "kept": ratio.name not in benchmark.regressions(found[benchmark.name]),
        }
        for benchmark in benchmarks
        for ratio in benchmark.ratios
    ]


def run(args: argparse.Namespace) -> int:
    """Do what the arguments say; returns the exit status."""
    stored = read_store(args.store)
    benchmarks = chosen(stored, args.only, args.quick)
    if args.list:
        print_table(table_of(benchmarks, None))
        return 0
    found = {}
    for benchmark in benchmarks:
        notice(f"measuring: {benchmark.name}")
        found[benchmark.name] = benchmark.measure() if args.update else best_of(benchmark)
    if args.update:
        stored = [
            updated(item, found[item.name]) if item.name in found else item for item in stored
        ]
        write_store(stored, args.store)
        benchmarks = chosen(stored, args.only, args.quick)
    if args.json:
        print(json.dumps(as_json(benchmarks, found), indent=1))
    else:
        print_table(table_of(benchmarks, found))
    return int(any(benchmark.regressions(found[benchmark.name]) for benchmark in benchmarks))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--quick", action="store_true", help="only those that take seconds")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these")
    parser.add_argument("--update", action="store_true", help="store what is measured now")
    parser.add_argument("--list", action="store_true", help="print what is stored")
    parser.add_argument("--json", action="store_true", help="print numbers for programs")
    parser.add_argument(
        "--store", type=Path, default=STORE, metavar="FILE", help="the stored ratios"
    )
    args = parser.parse_args(arguments)
    try:
        return run(args)
    except HwpError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status


if __name__ == "__main__":
    sys.exit(main())
