"""The result file: writing, reading that checks what it is given, and how it is found."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadResult
from hwp_bench.base.errors import place as checked_place
from hwp_bench.base.files import inside, read_json, sha256_json, write_json
from hwp_bench.base.records import parse_record, without_schema
from hwp_bench.results.schema import MAX_BYTES, Results

#: Version of the result file.
SCHEMA = "hwp-results/1"
#: Name of the file that makes a folder an ablation.
ABLATION = "ablation.json"
#: Version of that file.
ABLATION_SCHEMA = "hwp-ablation/1"


def write_results(path: str | os.PathLike[str], results: Results) -> Path:
    """Write a result file atomically, with the digest of its content."""
    value = asdict(results)
    return write_json(path, {"schema": SCHEMA, "digest": sha256_json(value), **value})


def content_digest(value: Mapping[str, Any]) -> tuple[str | None, str]:
    """Return the digest that a result file states, and that of its content."""
    content = {name: item for name, item in value.items() if name not in ("schema", "digest")}
    return value.get("digest"), sha256_json(content)


def read_results(path: str | os.PathLike[str]) -> Results:
    """Read a result file, or the `results.json` of a results folder.

    Raises:
        BadInput: missing or no JSON.
        BadResult: of another version, a field is missing, unknown, of the wrong type, or a
            number is out of its range, or a text is too long; the field is named.
    """
    # Whether the content was changed by hand is for `verify` and the leaderboard to say.
    return _read(checked_place(path, "path"))[0]


def read_unchanged(path: str | os.PathLike[str]) -> Results:
    """Read a result file that nobody has changed by hand, as `read_results`."""
    results, content = _read(Path(path))
    stated, found = content_digest(content)
    if stated not in (None, found):
        raise BadResult(
            "is not the digest of the content: the result was changed by hand",
            where=path,
            field="digest",
            remedy="Evaluate again; `hwp-bench verify` shows what differs.",
        )
    return results


def _read(path: Path) -> tuple[Results, Mapping[str, Any]]:
    """Return the results, and the file as JSON."""
    path = path / "results.json" if path.is_dir() else path
    content = read_json(path, max_bytes=MAX_BYTES)
    value = without_schema(content, SCHEMA, where=path)
    value.pop("digest", None)
    return parse_record(Results, value, where=path), content


def result_files(path: str | os.PathLike[str]) -> list[Path]:
    """Return the result files that a path stands for.

    It is a `results.json`, a results folder, an `ablation.json`, an ablation's folder, the folder
    of several methods and seeds, or that of one of these methods.
    """
    place = Path(path)
    if several := _several(place):
        return several
    record = place / ABLATION if place.is_dir() else place
    if record.name != ABLATION or not record.is_file():
        return [place / "results.json" if place.is_dir() else place]
    value = without_schema(read_json(record), ABLATION_SCHEMA, where=record)
    try:
        names = [name for variant in value["variants"] for name in variant["results"]]
        return [inside(record.parent, name) for name in names]
    except (KeyError, TypeError) as error:
        raise BadResult("does not list its results", where=record, field="variants") from error


def seed_folder(folder: Path, method: str, seed: int) -> Path:
    """Return the results folder of one seed of a method in the folder of several."""
    return folder / method / f"seed-{seed}"


def _several(place: Path) -> list[Path]:
    """Return the result files of several methods and seeds, or of one's seeds; none of others."""
    if _single(place):
        return []
    return sorted(place.glob("seed-*/results.json")) or sorted(place.glob("*/seed-*/results.json"))


def _single(folder: Path) -> bool:
    return any((folder / name).is_file() for name in ("results.json", ABLATION))


def results_among(paths: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Return the result files that several paths stand for, such as `runs/*`.

    Folders and files that hold no results (figures, notes, other commands' folders) are left out
    and said, as long as another path holds some.
    """
    places = list(paths)
    others = [path for path in places if _holds_none(Path(path))]
    if len(others) == len(places):
        others = []
    for path in others:
        notice(f"left out: {os.fspath(path)} holds no results")
    return [file for path in places if path not in others for file in result_files(path)]


def _holds_none(place: Path) -> bool:
    if place.is_dir():
        return not _single(place) and not _several(place)
    return place.is_file() and place.suffix != ".json"


def read_all(paths: Iterable[str | os.PathLike[str]]) -> list[Results]:
    """Read every evaluation that some paths stand for, in order; none was changed by hand."""
    return [read_unchanged(file) for file in results_among(paths)]
