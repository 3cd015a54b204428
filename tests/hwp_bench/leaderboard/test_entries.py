"""Entries of the leaderboard. Oracle: what a changed byte must cause."""

from __future__ import annotations

import json
import os
import subprocess
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest
from made_entries import OTHER_SCORES, complete_results, with_keys

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.packages import data_folder
from hwp_bench.cli.main import main
from hwp_bench.evaluation.sentences import find_missing
from hwp_bench.leaderboard.entries import entry_name, read_entries
from hwp_bench.leaderboard.entries import make_entry as entry_of
from hwp_bench.leaderboard.rules import check_complete, check_entries, check_unchanged
from hwp_bench.leaderboard.soundness import check_bound
from hwp_bench.leaderboard.submit import add_entry
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.results import FrameResult, Results, write_results


@pytest.fixture
def make_entry(make_results):
    """Return a function that makes results fit for the leaderboard."""

    def make(name: str = "plain", psnr: float = 20.0, **changes: object) -> Results:
        result = make_results(name, psnr)
        scores = {**OTHER_SCORES, "ssim": 0.5, "oriented_distance": 0.01}
        frames = [FrameResult(18 + i, {**scores, "psnr": psnr + i}, None) for i in range(2)]
        protocols = json.loads(json.dumps({p.name: p.as_dict() for p in PROTOCOLS}))
        captures = [replace(result.captures[0], frames=frames)]
        given = {"captures": captures, "protocols": protocols, **changes}
        return with_keys(replace(result, **given))

    return make


def test_an_entry_is_the_whole_result(make_entry, tmp_path: Path) -> None:
    results = make_entry("plain")
    file = add_entry(tmp_path, results)
    assert file.stem == entry_name(results)
    assert file.stem.startswith("plain-smoke-seed0-")
    assert [entry.results for entry in read_entries(tmp_path)] == [results]
    add_entry(tmp_path, results)
    add_entry(tmp_path, make_entry("mine", 22.0, budget={"seconds": 60, "steps": None}))
    assert [entry.name.split("-seed")[0] for entry in read_entries(tmp_path)] == [
        "mine-smoke-60s",
        "plain-smoke",
    ]
    check_entries(read_entries(tmp_path))


def test_a_changed_score_is_found(make_entry, tmp_path) -> None:
    file = add_entry(tmp_path, make_entry())
    file.write_text(file.read_text().replace('"psnr": 20.0', '"psnr": 29.0'))
    with pytest.raises(BadResult, match="changed by hand"):
        read_entries(tmp_path)


def test_other_names_and_fields_are_refused(make_entry, tmp_path) -> None:
    file = add_entry(tmp_path, make_entry())
    moved = file.rename(tmp_path / "other.json")
    with pytest.raises(BadResult, match="must be called"):
        read_entries(tmp_path)
    value = json.loads(moved.read_text())
    moved.write_text(json.dumps({**value, "note": "x"}))
    with pytest.raises(BadResult, match="note"):
        read_entries(tmp_path)
    moved.write_text("{}")
    with pytest.raises(
        BadResult, match="schema: is find_missing where 'hwp-leaderboard-entry/1' is read"
    ):
        read_entries(tmp_path)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"suite": "captures"}, "no suite that everybody has"),
        ({"frames": "clean"}, "clean frames"),
        ({"protocols": {}}, "other protocols"),
    ],
)
def test_what_cannot_be_ranked_is_refused(make_entry, tmp_path, changes, problem) -> None:
    with pytest.raises(UsageError, match=problem):
        add_entry(tmp_path, make_entry(**changes))
    assert list(tmp_path.iterdir()) == []


def test_other_data_in_one_suite_is_refused(make_entry, tmp_path) -> None:
    add_entry(tmp_path, make_entry())
    other = make_entry("mine")
    other = replace(other, captures=[replace(other.captures[0], digest="other")])
    with pytest.raises(UsageError, match="other captures, splits or test frames"):
        add_entry(tmp_path, other)
    # In another suite there is nothing that it would have to be like.
    add_entry(tmp_path, with_keys(replace(other, suite="wild-test")))


def test_a_result_without_the_headline_metrics_is_refused(
    make_results, make_entry, tmp_path
) -> None:
    bare = replace(make_results(), protocols=make_entry().protocols)
    with pytest.raises(BadResult, match="lacks a headline metric"):
        add_entry(tmp_path, bare)


def test_the_entries_that_ship_are_sound() -> None:
    for entry in check_entries(read_entries(data_folder("leaderboard") / "entries")):
        check_complete(entry)
        check_bound(entry)


def test_no_entry_differs_from_the_branch_that_a_pull_request_goes_to(tmp_path: Path) -> None:
    """CI names the branch; `tests/.../test_submit.py` shows that a change is found."""
    base = os.environ.get("HWP_LEADERBOARD_BASE")
    if not base:
        pytest.skip("HWP_LEADERBOARD_BASE names no branch")
    place = "leaderboard/entries"
    root = Path(__file__).parents[3]
    archive = ["git", "-C", str(root), "archive", "--output", str(tmp_path / "b.tar")]
    subprocess.run([*archive, base, place], check=True)
    with tarfile.open(tmp_path / "b.tar") as tar:
        tar.extractall(tmp_path, filter="data")
    assert check_unchanged(root / place, tmp_path / place) >= 0


def test_an_incomplete_row_is_found() -> None:
    """Oracle: what was taken away."""
    whole = complete_results()
    assert find_missing(whole) == []
    first, second = whole.captures
    few = replace(first, frames=first.frames[1:])
    alien = replace(second, id="capture99")
    split = replace(second, split_digest="other")
    for captures, problem in (
        ([first], "lacks 1 of 2 captures: capture4"),
        ([few, second], "capture0: lacks test frames"),
        ([first, second, alien], "not of the suite: capture99"),
        ([first, first, second], "a capture twice"),
        ([first, split], "capture4: is split otherwise"),
    ):
        with pytest.raises(BadResult, match=problem):
            check_complete(entry_of(replace(whole, captures=captures)))


def test_the_command(tmp_path, capsys) -> None:
    write_results(tmp_path / "run" / "results.json", complete_results())
    entries = ["--entries", str(tmp_path / "entries")]
    assert main(["leaderboard", "add", str(tmp_path / "run"), *entries]) == 0
    assert main(["leaderboard", "check", *entries]) == 0
    assert capsys.readouterr().out == "1 entries, all sound\n"
    assert main(["leaderboard", "build", "-o", str(tmp_path / "site"), *entries]) == 0
    assert (tmp_path / "site" / "index.html").is_file()
    # Building again replaces the site, but never another folder.
    assert main(["leaderboard", "build", "-o", str(tmp_path / "site"), *entries]) == 0
    assert main(["leaderboard", "build", "-o", str(tmp_path / "run"), *entries]) == 2
    assert (tmp_path / "run" / "results.json").is_file()
