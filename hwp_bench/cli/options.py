"""Options that several commands share, what they stand for, and how commands print JSON."""

from __future__ import annotations

import argparse
import json
import shlex
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hwp_bench.base.console import notice
from hwp_bench.base.errors import UsageError, has_odd_characters, shown
from hwp_bench.base.records import parse_toml
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.taxonomy import SUITES

if TYPE_CHECKING:
    from hwp_bench.capture.splits import Split

# Deepest table that a dotted name leads to.
_MOST_TABLES = 8
# What begins a string, a list or a table.
_OPENING = frozenset("\"'[{")


def add_json(parser: argparse.ArgumentParser, what: str = "print JSON") -> None:
    """Add `--json`, for which a command prints with `print_json`."""
    parser.add_argument("--json", action="store_true", help=what)


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output."""
    print(json.dumps(value, indent=1))


def print_result(as_json: bool, value: Any, lines: Iterable[str]) -> int:
    """Print a value as JSON where that was asked for, else lines; returns the exit status, 0."""
    if as_json:
        print_json(value)
    else:
        print("\n".join(lines))
    return 0


def say_next(*words: object) -> None:
    """Say on standard error which command a person gives next."""
    notice(f"next: {shlex.join(map(str, words))}")


def named_table(caption: str, titles: str, rows: Iterable[Sequence[Cell]]) -> Table:
    """Return a table that ranks nothing; the titles of its columns are divided by commas."""
    columns = tuple(Column(title) for title in titles.split(", "))
    return Table(caption, columns, tuple(map(tuple, rows)), ranked=False)


#: An option that takes several values and may be given again.
SEVERAL: Mapping[str, Any] = {"nargs": "+", "action": "extend", "default": []}


def add_results(parser: argparse.ArgumentParser, nargs: str = "+", more: str = "") -> None:
    """Add RESULTS, read by `report.sources.read_sources` or `results.read_all`."""
    text = f"results folder, results.json, or ablation folder{more}"
    parser.add_argument("results", nargs=nargs, metavar="RESULTS", help=text)


def add_capture_folders(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add `--capture`, for facts about captures that results do not hold."""
    text = f"capture folders, for {purpose} (simulated ones are found in the cache)"
    parser.add_argument("--capture", **SEVERAL, metavar="PATH", help=text)


def add_suite_or_captures(parser: argparse.ArgumentParser, sealed: str = "") -> None:
    """Add `--suite`, `--capture` and, with a help, `--sealed`, of which one can be given.

    `--splits` goes with them.
    """
    add = parser.add_mutually_exclusive_group().add_argument
    text = "captures that are rendered, or imported, on first use (default mini)"
    add("--suite", choices=SUITES, default="mini", help=text)
    add("--capture", **SEVERAL, metavar="PATH", help="capture folders, instead of a suite")
    if sealed:
        add("--sealed", metavar="DIR", help=sealed)
    add_splits(parser)


def add_out(parser: argparse.ArgumentParser, text: str, metavar: str = "DIR") -> None:
    """Add `-o`, which must be given."""
    parser.add_argument("-o", "--out", type=Path, required=True, metavar=metavar, help=text)


def add_splits(parser: argparse.ArgumentParser) -> None:
    """Add `--splits`, which `splits_of` reads."""
    parser.add_argument("--splits", help="split file (default: the 80/10/10 rule)")


def add_overwrite(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--overwrite`, with which a command replaces what is there."""
    parser.add_argument("--overwrite", action="store_true", help=f"replace {what}")


def splits_of(args: argparse.Namespace) -> Mapping[str, Split] | None:
    """Return the splits of the file that was named; None takes the rule."""
    from hwp_bench.capture.splits import read_splits

    return read_splits(args.splits) if args.splits else None


def captures_of(places: Sequence[str] | None, file: Path) -> list[Path]:
    """Return the capture folders that a result is verified with."""
    from hwp_bench.evaluation.verify import capture_folders
    from hwp_bench.results import read_results
    from hwp_bench.suites.suite import ensure_suite

    if places:
        folders = capture_folders([Path(place) for place in places])
        if not folders:
            raise UsageError("there is no capture", field="--capture")
        return folders
    suite = read_results(file).suite
    if suite not in SUITES:
        raise UsageError(
            f"was not made on a suite ({suite})",
            where=file,
            field="suite",
            remedy="Say where its captures lie with --capture.",
        )
    return ensure_suite(suite)


def overrides(texts: Iterable[str]) -> dict[str, Any]:
    """Read texts of the form `NAME=VALUE`."""
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not all(part.isidentifier() for part in name.split(".")):
            raise UsageError(f"{text[:100]!r} is not NAME=VALUE", field="--set")
        if name.count(".") > _MOST_TABLES:
            raise UsageError(f"{text[:100]!r} names too deep a table", field="--set")
        place = f"{name[:100]}={shown(value)[:40]}"
        try:
            content = parse_toml(f"value = {value}", where="--set", field=place, error=UsageError)
            found[name] = content["value"]
        except UsageError as error:
            # A word without quotation marks is text; what is TOML but out of bounds is not.
            if not isinstance(error.__cause__, tomllib.TOMLDecodeError):
                raise
            if value.lstrip()[:1] in _OPENING:
                problem = f"looks like TOML and is not ({error.__cause__})"
                remedy = "Close it; a text that begins so is written in quotation marks."
                raise UsageError(problem, where="--set", field=place, remedy=remedy) from error
            if has_odd_characters(value):
                problem = "holds a control character, or cannot be Unicode"
                raise UsageError(problem, where="--set", field=place) from error
            found[name] = value
    _check_tables(found)
    return found


def _check_tables(found: Mapping[str, Any]) -> None:
    """Refuse a name that is a value and, in another one, a table."""
    for name in found:
        parts = name.split(".")
        for count in range(1, len(parts)):
            above = ".".join(parts[:count])
            if not isinstance(found.get(above, {}), dict):
                problem = f"{above!r} is a value, and a table in {name!r}"
                raise UsageError(problem, field="--set", remedy="Give one of them.")
