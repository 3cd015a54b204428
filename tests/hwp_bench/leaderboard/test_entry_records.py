"""Submissions, checks, levels and revisions. Oracle: the rules of docs/submissions.md by hand."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import pytest

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.leaderboard.entries import (
    Entry,
    make_entry,
    read_entries,
    refuse_installed,
    write_check,
    write_entry,
)
from hwp_bench.leaderboard.records import (
    BADGES,
    LEVELS,
    Check,
    Submission,
    badge,
    in_force,
    level,
)
from hwp_bench.leaderboard.rules import check_entries, current, history, tables_of


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
