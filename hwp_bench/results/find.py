"""Find result files: one evaluation, or every evaluation of an ablation."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from hwp_bench.base.errors import BadResult
from hwp_bench.base.files import inside, read_json
from hwp_bench.results.schema import Results, read_results

#: Name of the file that makes a folder an ablation.
ABLATION = "ablation.json"
#: Version of that file.
ABLATION_SCHEMA = "hwp-ablation/1"


def result_files(path: str | os.PathLike[str]) -> list[Path]:
    """Return the result files that a path stands for.

    Args:
        path: a `results.json`, a results folder, an `ablation.json`, or an ablation's folder.

    Raises:
        BadInput: an `ablation.json` is damaged, or names a file outside its folder.
        BadResult: it is of another version.
    """
    place = Path(path)
    record = place / ABLATION if place.is_dir() else place
    if record.name != ABLATION or not record.is_file():
        return [place / "results.json" if place.is_dir() else place]
    value = read_json(record)
    if not isinstance(value, dict) or value.get("schema") != ABLATION_SCHEMA:
        raise BadResult(f"is no ablation of schema {ABLATION_SCHEMA}", where=record)
    try:
        names = [name for variant in value["variants"] for name in variant["results"]]
        return [inside(record.parent, name) for name in names]
    except (KeyError, TypeError) as error:
        raise BadResult("does not list its results", where=record, field="variants") from error


def read_all(paths: Iterable[str | os.PathLike[str]]) -> list[Results]:
    """Read every evaluation that some paths stand for, in order.

    Raises:
        BadInput, BadResult: one is missing or damaged.
    """
    return [read_results(file) for path in paths for file in result_files(path)]
