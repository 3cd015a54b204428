"""Submissions, checks, levels and revisions. Oracle: the rules of docs/submissions.md by hand."""

from __future__ import annotations

import itertools
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
from hwp_bench.leaderboard.entries import (
    BADGES,
    LEVELS,
    Check,
    Entry,
    Submission,
    badge,
    entry_name,
    in_force,
    level,
    make_entry,
    read_entries,
    refuse_installed,
    write_check,
    write_entry,
)
from hwp_bench.leaderboard.rules import (
    check_bound,
    check_complete,
    check_entries,
    check_unchanged,
    current,
    history,
    tables_of,
)
from hwp_bench.leaderboard.submit import add_entries
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.results import FrameResult, Results, write_results
from hwp_bench.suites.suite import find_missing


def check_of(entry: Entry, kind: str, verdict: str = "reproduces", day: int = 1) -> Check:
    """A check of an entry."""
    return Check(
        entry=entry.name,
        entry_digest=entry.digest,
        kind=kind,  # type: ignore[arg-type]
        verdict=verdict,  # type: ignore[arg-type]
        date=f"2026-01-{day:02d}T00:00:00+00:00",
        by="maintainers",
        toolkit="0.1.0",
        code="c",
        machine="m",
        frames=2,
        cross_checked=1,
        differences=0 if verdict == "reproduces" else 3,
        rerun="0" * 64 if kind == "re-run" else None,
        scores={"psnr": 20.0} if kind == "re-run" else {},
    )


def test_a_row_has_the_level_that_none_of_its_checks_denies(make_results) -> None:
    """Every order of two kinds of check with two verdicts, against the rule written out."""
    entry = make_entry(make_results())
    kinds = list(itertools.product(("rescored", "re-run"), ("reproduces", "differs")))
    for count in range(4):
        for chosen in itertools.product(kinds, repeat=count):
            checks = [check_of(entry, *item, day=day + 1) for day, item in enumerate(chosen)]
            told = {kind: {v for k, v in chosen if k == kind} for kind in ("rescored", "re-run")}
            wanted = "self-reported"
            if told["rescored"] == {"reproduces"}:
                wanted = "rescored"
            if told["re-run"] == {"reproduces"}:
                wanted = "re-run"
            # Dates and order decide nothing.
            assert level(reversed(checks)) == wanted
            if any(len(verdicts) == 2 for verdicts in told.values()):
                assert badge(checks) == "disputed"
            elif {"differs"} in told.values():
                assert badge(checks) == "differs"
            else:
                assert (
                    badge(checks)
                    == ("not tried", "scores hold", "reproduces")[LEVELS.index(wanted)]
                )
            assert badge(checks) in BADGES


def test_a_check_is_overruled_by_name_and_never_by_its_date(make_results, tmp_path: Path) -> None:
    entry = make_entry(make_results())
    forged = replace(check_of(entry, "re-run"), date="2099-01-01T00:00:00+00:00")
    honest = check_of(entry, "re-run", "differs")
    assert (level([forged, honest]), badge([honest, forged])) == ("self-reported", "disputed")
    final = replace(honest, overrules=[forged.digest], reason="this run was never made")
    assert (level([forged, final]), badge([forged, final])) == ("self-reported", "differs")
    # A check that was wrong itself is overruled in turn, and then overrules none.
    last = replace(check_of(entry, "re-run"), overrules=[final.digest], reason="wrong camera")
    assert in_force([final, last, forged]) == [last, forged]
    assert (level([final, last, forged]), badge([final, last])) == ("re-run", "reproduces")
    write_entry(tmp_path, entry)
    for check in (forged, final, last):
        write_check(tmp_path, check)
    (read,) = read_entries(tmp_path)
    assert {check.digest for check in read.checks} == {forged.digest, final.digest, last.digest}
    with pytest.raises(UsageError, match="gives a reason"):
        replace(honest, overrules=[forged.digest])


def test_a_submission_and_its_checks_come_back(make_results, tmp_path: Path) -> None:
    added = Submission("A person", links={"code": "https://a.b/c"}, avatars={"capture2": "0" * 64})
    entry = make_entry(make_results(), added)
    write_entry(tmp_path, entry)
    file = write_check(tmp_path, check_of(entry, "rescored"))
    (read,) = read_entries(tmp_path)
    assert read == replace(entry, checks=(check_of(entry, "rescored"),))
    assert read.level == "rescored"
    file.write_text(file.read_text("utf-8").replace('"maintainers"', '"others"'))
    with pytest.raises(BadResult, match="changed by hand"):
        read_entries(tmp_path)


def test_a_check_is_of_one_content(make_results, tmp_path: Path) -> None:
    entry = make_entry(make_results())
    write_entry(tmp_path, entry)
    write_check(tmp_path, replace(check_of(entry, "re-run"), entry_digest="0" * 64))
    with pytest.raises(BadResult, match="which is not there"):
        read_entries(tmp_path)


def test_a_submission_that_is_changed_by_hand_is_found(make_results, tmp_path: Path) -> None:
    file = write_entry(tmp_path, make_entry(make_results(), Submission("A person")))
    file.write_text(file.read_text("utf-8").replace("A person", "B person"))
    with pytest.raises(BadResult, match="changed by hand"):
        read_entries(tmp_path)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"reason": "because"}, "a revision needs a reason"),
        ({"revises": "other"}, "a revision needs a reason"),
        ({"links": {"video": "https://a.b"}}, "not a kind of link"),
        ({"links": {"code": "javascript:alert(1)"}}, "not an https:// address"),
        ({"links": {"code": 'https://a.b/"onclick='}}, "not an https:// address"),
    ],
)
def test_what_a_submission_cannot_say(changes, problem) -> None:
    with pytest.raises(UsageError, match=problem):
        Submission(**changes)


@pytest.fixture
def ranked(make_results):
    """A function that returns an entry fit for the leaderboard."""
    from hwp_bench.metrics import PROTOCOLS
    from hwp_bench.results import FrameResult

    def make(name: str = "plain", submission: Submission | None = None, **changes) -> Entry:
        results = make_results(name)
        frame = FrameResult(18, {"psnr": 20.0, "ssim": 0.5, "oriented_distance": 0.01}, None)
        protocols = json.loads(json.dumps({p.name: p.as_dict() for p in PROTOCOLS}))
        captures = [replace(results.captures[0], frames=[frame])]
        given = {"captures": captures, "protocols": protocols, **changes}
        return make_entry(replace(results, **given), submission)

    return make


def test_a_revision_takes_the_place_of_what_it_revises(ranked) -> None:
    first = ranked()
    second = ranked(submission=Submission(revises=first.name, reason="a wrong link"))
    third = ranked(submission=Submission(revises=second.name, reason="another wrong link"))
    other = ranked("mine")
    entries = check_entries([third, other, first, second])
    assert [entry.name for entry in current(entries)] == [third.name, other.name]
    assert history(third, entries) == [second, first]
    assert history(other, entries) == []


def test_what_cannot_be_revised(ranked) -> None:
    first, mine = ranked(), ranked("mine")
    again = Submission(revises=first.name, reason="r")
    for rows, problem in (
        ([ranked(submission=again)], "which is not there"),
        ([first, ranked("mine", submission=again)], "of another method or suite"),
        ([first, ranked(submission=again), ranked(submission=again, seed=1)], "already"),
    ):
        with pytest.raises(UsageError, match=problem):
            check_entries([*rows, mine])


def test_versions_of_a_protocol_have_tables_of_their_own(ranked) -> None:
    now, old = ranked(), ranked("older")
    protocols = dict(old.results.protocols)
    protocols["hwp-v0"] = {**protocols.pop("hwp-v1"), "name": "hwp-v0", "mask_erosion": 0}
    captures = [replace(old.results.captures[0], split_digest="other")]
    old = make_entry(replace(old.results, protocols=protocols, captures=captures))
    entries = check_entries([old, now])
    assert tables_of(entries) == {("smoke", "hwp-v1"): [now], ("smoke", "hwp-v0"): [old]}
    # The name of this version with other settings is no version.
    protocols["hwp-v1"] = {**protocols["hwp-v0"], "name": "hwp-v1"}
    with pytest.raises(UsageError, match="other protocols"):
        check_entries([make_entry(replace(old.results, protocols=protocols))])


def test_nothing_is_written_into_an_installed_package(ranked, tmp_path: Path) -> None:
    for place in (
        tmp_path / "lib" / "site-packages" / "hwp_bench" / "_data" / "leaderboard" / "entries",
        Path(__file__).parents[3] / "hwp_bench" / "_data",
    ):
        with pytest.raises(UsageError, match="installed package"):
            write_entry(place, ranked())
        assert not place.exists()
    refuse_installed(tmp_path)


@pytest.fixture
def fit_results(make_results):
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


def test_an_entry_is_the_whole_result(fit_results, tmp_path: Path) -> None:
    results = fit_results("plain")
    (file,) = add_entries(tmp_path, [results])
    assert file.stem == entry_name(results)
    assert file.stem.startswith("plain-smoke-seed0-")
    assert [entry.results for entry in read_entries(tmp_path)] == [results]
    add_entries(tmp_path, [results])
    add_entries(tmp_path, [fit_results("mine", 22.0, budget={"seconds": 60, "steps": None})])
    assert [entry.name.split("-seed")[0] for entry in read_entries(tmp_path)] == [
        "mine-smoke-60s",
        "plain-smoke",
    ]
    check_entries(read_entries(tmp_path))
    with pytest.raises(BadResult, match="not yet"):
        add_entries(tmp_path, [fit_results("late", started="2199-01-01T00:00:00+00:00")])


def test_a_changed_score_is_found(fit_results, tmp_path) -> None:
    (file,) = add_entries(tmp_path, [fit_results()])
    file.write_text(file.read_text().replace('"psnr": 20.0', '"psnr": 29.0'))
    with pytest.raises(BadResult, match="changed by hand"):
        read_entries(tmp_path)


def test_other_names_and_fields_are_refused(fit_results, tmp_path) -> None:
    (file,) = add_entries(tmp_path, [fit_results()])
    moved = file.rename(tmp_path / "other.json")
    with pytest.raises(BadResult, match="must be called"):
        read_entries(tmp_path)
    value = json.loads(moved.read_text())
    moved.write_text(json.dumps({**value, "note": "x"}))
    with pytest.raises(BadResult, match="note"):
        read_entries(tmp_path)
    moved.write_text("{}")
    with pytest.raises(
        BadResult, match="schema: is missing where 'hwp-leaderboard-entry/1' is read"
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
def test_what_cannot_be_ranked_is_refused(fit_results, tmp_path, changes, problem) -> None:
    with pytest.raises(UsageError, match=problem):
        add_entries(tmp_path, [fit_results(**changes)])
    assert list(tmp_path.iterdir()) == []


def test_other_data_in_one_suite_is_refused(fit_results, tmp_path) -> None:
    add_entries(tmp_path, [fit_results()])
    other = fit_results("mine")
    other = replace(other, captures=[replace(other.captures[0], digest="other")])
    with pytest.raises(UsageError, match="other captures, splits or test frames"):
        add_entries(tmp_path, [other])
    # In another suite there is nothing that it would have to be like.
    add_entries(tmp_path, [with_keys(replace(other, suite="wild-test"))])


def test_a_result_without_the_headline_metrics_is_refused(
    make_results, fit_results, tmp_path
) -> None:
    bare = replace(make_results(), protocols=fit_results().protocols)
    with pytest.raises(BadResult, match="lacks a headline metric"):
        add_entries(tmp_path, [bare])


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
            check_complete(make_entry(replace(whole, captures=captures)))


def test_the_command(tmp_path, capsys) -> None:
    write_results(tmp_path / "run" / "results.json", complete_results())
    entries = ["--entries", str(tmp_path / "entries")]
    assert main(["dev", "leaderboard", "add", str(tmp_path / "run"), *entries]) == 0
    assert main(["leaderboard", "check", *entries]) == 0
    assert capsys.readouterr().out == "1 entries, all sound\n"
    assert main(["leaderboard", "build", "-o", str(tmp_path / "site"), *entries]) == 0
    assert (tmp_path / "site" / "index.html").is_file()
    # Building again replaces the site, but never another folder.
    assert main(["leaderboard", "build", "-o", str(tmp_path / "site"), *entries]) == 0
    assert main(["leaderboard", "build", "-o", str(tmp_path / "run"), *entries]) == 2
    assert (tmp_path / "run" / "results.json").is_file()
