"""Results, entries and checks as strangers may write them. Oracle: status 0, 1 or 2, one message.

Whatever is read is within the bounds of `hwp_bench/results/schema.py`, and is written and read
again as it is.
"""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from made_entries import check_of, complete_results, with_keys
from strange_values import as_json, edited

from hwp_bench.base.errors import BadInput, BadResult
from hwp_bench.base.files import sha256_json
from hwp_bench.base.records import parse_record
from hwp_bench.cli.main import main
from hwp_bench.leaderboard.entries import Check, entry_name, make_entry, write_entry
from hwp_bench.results import CurvePoint, Results, read_results, write_results
from hwp_bench.results.schema import MAX_BYTES
from hwp_bench.results.store import read_unchanged

_MANY = settings(
    max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
_FEW = settings(_MANY, max_examples=5)


def _sound() -> Results:
    results = complete_results("ours", lambda number, frame: 20.0 + number + frame % 3)
    curve = [CurvePoint(0, 0.5, 10**8, {"psnr": 15.0}), CurvePoint(9, 1.5, 10**8, {"psnr": 19.0})]
    return replace(results, captures=[replace(c, curve=curve) for c in results.captures])


SOUND: dict[str, Any] = json.loads(json.dumps(asdict(_sound())))
CHECK: dict[str, Any] = json.loads(json.dumps(asdict(check_of(make_entry(_sound()), "re-run"))))


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """The results of another method, which are sound."""
    results = _sound()
    named = replace(results.method, name="other", title="Other", digest="o")
    return write_results(tmp_path / "other" / "results.json", replace(results, method=named)).parent


def told(capsys: pytest.CaptureFixture[str], *words: str) -> int:
    """Run a command: no traceback, text that can be encoded, and one message where it fails."""
    capsys.readouterr()
    status = main(list(words))
    captured = capsys.readouterr()
    captured.out.encode()
    captured.err.encode()
    assert status in (0, 1, 2)
    assert captured.err.count("hwp-bench: error: ") == (status != 0), captured.err
    return status


def written(folder: Path, value: Any) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "results.json").write_text(as_json({"schema": "hwp-results/1", **value}))
    return folder


@_MANY
@given(edited(SOUND))
def test_what_is_read_is_written_and_read_again(tmp_path: Path, value: dict[str, Any]) -> None:
    place = written(tmp_path / "strange", value)
    try:
        results = read_results(place)
    except BadInput:
        return
    assert read_unchanged(write_results(tmp_path / "again.json", results)) == results


@_MANY
@given(edited(SOUND))
def test_tables_of_strange_results(tmp_path: Path, other: Path, capsys, value) -> None:
    place = str(written(tmp_path / "strange", value))
    for by, form in (("overall", "terminal"), ("captures", "csv"), ("rank", "tex")):
        told(capsys, "table", place, str(other), "--by", by, "--format", form)
    told(capsys, "compare", place, str(other), "--resamples", "20")


@_FEW
@given(edited(SOUND))
def test_costs_and_reports_of_strange_results(tmp_path: Path, other: Path, capsys, value) -> None:
    place = str(written(tmp_path / "strange", value))
    told(capsys, "curves", place, str(other), "--json", "-o", str(tmp_path / "cost"))
    told(capsys, "report", place, str(other), "-o", str(tmp_path / "report"))


@_MANY
@given(edited(SOUND))
def test_strange_entries(tmp_path: Path, capsys, value: dict[str, Any]) -> None:
    """An entry that passes `check` can be shown and built."""
    folder = tmp_path / "entries"
    for file in folder.glob("*.json"):
        file.unlink()
    write_entry(folder, make_entry(with_keys(replace(_sound(), seed=3))))
    name, digest = "strange", ""
    try:
        results = with_keys(parse_record(Results, value, where="strange"))
        value = json.loads(json.dumps(asdict(results)))
        digest = sha256_json(value)
        name = entry_name(results, digest)
    except BadResult:
        pass
    file = folder / f"{name}.json"
    content = {"schema": "hwp-leaderboard-entry/1", "digest": digest, "results": value}
    file.write_text(as_json(content))
    status = told(capsys, "leaderboard", "check", "--entries", str(folder))
    assert told(capsys, "leaderboard", "show", "--entries", str(folder)) == 0
    if status == 0 and name != "strange":
        site = str(tmp_path / "site")
        assert told(capsys, "leaderboard", "build", "-o", site, "--entries", str(folder)) == 0


@_MANY
@given(edited(CHECK))
@example({**CHECK, "kind": "\ud800"})
@example({**CHECK, "kind": "\ud800", "date": "\ud800"})
def test_strange_checks(tmp_path: Path, capsys, value: dict[str, Any]) -> None:
    folder = tmp_path / "entries"
    write_entry(folder, make_entry(_sound()))
    digest = ""
    with contextlib.suppress(BadResult):
        parse_record(Check, value, where="strange")
        digest = sha256_json(value)
    checks = folder / "checks"
    checks.mkdir(exist_ok=True)
    content = {"schema": "hwp-leaderboard-check/1", "digest": digest, "check": value}
    (checks / "strange.json").write_text(as_json(content))
    told(capsys, "leaderboard", "check", "--entries", str(folder))
    assert told(capsys, "leaderboard", "show", "--entries", str(folder)) == 0


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda v: v["method"].update(title="x" * 3_000_000), "at most 1,000 characters"),
        (lambda v: v["budget"].update(seconds="much"), "budget.seconds: is 'much'"),
        (lambda v: v["budget"].update(hours=1), "budget.hours"),
        (lambda v: v.update(seed=-1), "seed: is -1"),
        (lambda v: v["captures"][0].update(device="a\nb"), "device"),
        (lambda v: v["captures"][0].update(failure="x" * 20_000), "0 to 10,000 characters"),
        (lambda v: v["captures"][0].update(hands="three"), "one of right, left, both"),
        (lambda v: v["captures"][0].update(fit_seconds=-1), "captures[0].fit_seconds: is -1"),
        (
            lambda v: v["captures"][0].update(steps=2**60),
            "captures[0].steps: is 1152921504606846976",
        ),
        (
            lambda v: v["captures"][0].update(curve=v["captures"][0]["curve"] * 9000),
            "10,000 entries",
        ),
        (lambda v: v.update(captures=v["captures"] * 600), "0 to 1,000 entries"),
    ],
)
def test_bounds_are_named(tmp_path: Path, change, problem: str) -> None:
    value = json.loads(json.dumps(SOUND))
    change(value)
    with pytest.raises(BadResult) as caught:
        read_results(written(tmp_path, value))
    assert problem in str(caught.value)
    assert len(str(caught.value)) < 500


def test_a_file_that_is_too_large_is_not_parsed(tmp_path: Path) -> None:
    file = written(tmp_path, SOUND) / "results.json"
    with file.open("r+b") as stream:
        stream.truncate(MAX_BYTES + 1)
    with pytest.raises(BadInput, match="holds more than the"):
        read_results(file)
