"""Edits of entries that keep the digest right. Oracle: what was edited; honest rows stay."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from made_entries import check_of, complete_results, with_keys

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.files import cache_root, sha256_json
from hwp_bench.base.records import parse_record
from hwp_bench.cli.main import main
from hwp_bench.leaderboard.board import method_rows, ranks_of
from hwp_bench.leaderboard.entries import (
    Submission,
    entry_name,
    make_entry,
    read_entries,
    write_check,
    write_entry,
)
from hwp_bench.leaderboard.rules import (
    check_dates,
    check_names,
    off_the_data,
    register,
    repeats,
    sound_entries,
)
from hwp_bench.leaderboard.submit import add_entries
from hwp_bench.leaderboard.suite_data import (
    CaptureData,
    SuiteData,
    Version,
    joined_data,
    on_current_data,
    read_suite_data,
    rendered_data,
    write_suite_data,
)
from hwp_bench.metrics import penalty
from hwp_bench.results import Results, write_results
from hwp_bench.sim.produce.capture import RENDERER


def forged(folder: Path, change: Callable[[dict], object], *, keys: bool = False) -> Path:
    """Write an entry that was edited as a whole; its digest and file name fit, and its keys may."""
    value = json.loads(json.dumps(asdict(complete_results("forger"))))
    change(value)
    try:
        results = parse_record(Results, value, where="forged")
        if keys:
            results = with_keys(results)
            value = json.loads(json.dumps(asdict(results)))
        name = entry_name(results, sha256_json(value))
    except BadResult:
        name = "forged"
    content = {"digest": sha256_json(value), "results": value}
    file = folder / f"{name}.json"
    folder.mkdir(exist_ok=True)
    file.write_text(json.dumps({"schema": "hwp-leaderboard-entry/1", **content}))
    return file


def _frame(value: dict) -> dict:
    return value["captures"][0]["frames"][0]


def _scores(**scores: float) -> Callable[[dict], None]:
    return lambda value: _frame(value)["scores"].update(scores)


#: Edits that a digest of the content cannot show, each with what must be said.
FORGERIES: dict[str, tuple[Callable[[dict], object], str]] = {
    "PSNR of 500": (_scores(psnr=500.0), "scores.psnr: is 500, but PSNR is from 0 to 100"),
    "SSIM of 7": (_scores(ssim=7.0), "scores.ssim: is 7, but SSIM is from -1 to 1"),
    "distance of -3": (_scores(oriented_distance=-3.0), "is -3, but Oriented distance is from 0"),
    "a sum that overflows": (_scores(psnr=1e308), "scores.psnr: is 1e+308"),
    "a score of its own": (_scores(mine=1e308), "scores.mine: is 1e+308"),
    "perturbations": (lambda v: v["captures"][0]["perturbations"].clear(), "perturbations []"),
    "a perturbation": (
        lambda v: v["captures"][0]["perturbations"].append("motion_blur"),
        "perturbations",
    ),
    "hands": (lambda v: v["captures"][0].update(hands="left"), "hands 'left'"),
    "masks": (lambda v: v["captures"][0].update(exact_masks=False), "exact_masks False"),
    "other data": (lambda v: v["captures"][0].update(digest="0" * 64), "not the data of the suite"),
    "budget": (lambda v: v["budget"].update(seconds=1.0), "is not the key"),
    "budget of text": (lambda v: v["budget"].update(seconds="much"), "budget.seconds: is 'much'"),
    "seed": (lambda v: v.update(seed=5), "is not the key"),
    "method": (lambda v: v["method"].update(name="wildghand"), "is not the key"),
    "settings": (lambda v: v["method"]["settings"].update(steps=1), "is not the key"),
    "a metric": (
        lambda v: [f["scores"].pop("psnr_box") for c in v["captures"] for f in c["frames"]],
        "metrics psnr_box",
    ),
    "a metric in one frame": (_scores(mine=1.0), "its metrics differ"),
    "a clip without frames": (
        lambda v: v["captures"][0].update(
            free_view={"digest": "f", "frames": [], "predictions_digest": "p"}
        ),
        "is not the key",
    ),
    "failure": (lambda v: _frame(v).update(failure="crashed"), "other scores than the penalties"),
    "failure of all": (lambda v: v["captures"][0].update(failure="crashed"), "3 have scores"),
    "a fit longer than its process": (
        lambda v: v["captures"][0].update(fit_seconds=9.0),
        "longer than the 4 s",
    ),
    "negative time": (lambda v: v["captures"][0].update(wall_seconds=-1.0), "wall_seconds: is -1"),
    "infinite time": (lambda v: v["captures"][0].update(wall_seconds=1.7e308), "wall_seconds: is"),
    "a capture left out": (lambda v: v["captures"].pop(), "lacks 1 of 2 captures"),
    "a frame left out": (lambda v: v["captures"][0]["frames"].pop(), "lacks test frames"),
    "a frame twice": (
        lambda v: v["captures"][0]["frames"].append(_frame(v)),
        "holds a frame twice",
    ),
    "not Unicode": (lambda v: v["method"].update(title="\ud800"), "not Unicode"),
    "a terminal's escape": (
        lambda v: v["environment"].update(system="\x1b[2J"),
        "environment.system: holds a control character",
    ),
    "a long title": (lambda v: v["method"].update(title="x" * 10**6), "at most 1,000 characters"),
    "a large environment": (
        lambda v: v["environment"].update({f"k{i}": "x" * 9999 for i in range(60)}),
        "environment: holds more than 500,000 characters",
    ),
}


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with one honest entry, and its name; not to be changed."""
    folder = tmp_path_factory.mktemp("honest")
    return folder, add_entries(folder, [complete_results("plain")])[0].stem


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_entry_is_refused_and_blocks_no_other(
    honest: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    change, problem = FORGERIES[name]
    false = forged(tmp_path, change)
    assert main(["leaderboard", "check", "--entries", str(tmp_path)]) in (1, 2)
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert problem in told
    (tmp_path / f"{honest[1]}.json").write_bytes((honest[0] / f"{honest[1]}.json").read_bytes())
    found = [entry.name for entry in sound_entries(tmp_path)]
    # A row that lacks captures is shown without a rank, as it says itself.
    assert found == sorted([honest[1], *([false.stem] if name == "a capture left out" else [])])
    add_entries(tmp_path, [complete_results("mine")])


def test_keys_that_fit_do_not_hide_other_data(tmp_path: Path, capsys) -> None:
    forged(tmp_path, lambda v: v["captures"][1].update(digest="0" * 64), keys=True)
    assert main(["leaderboard", "check", "--entries", str(tmp_path)]) == 1
    assert "capture4.digest: is not the data of the suite" in capsys.readouterr().err


@pytest.mark.parametrize(("flip", "status"), [(1.0, 0), (0.0, 1)])
def test_a_failed_frame_has_the_penalty_of_every_metric(
    tmp_path: Path, capsys, flip: float, status: int
) -> None:
    def change(value: dict) -> None:
        for frame in (frame for c in value["captures"] for frame in c["frames"]):
            frame["scores"]["flip"] = 0.5
        _frame(value).update(failure="crashed", scores={**penalty(), "flip": flip})

    forged(tmp_path, change, keys=True)
    assert main(["leaderboard", "check", "--entries", str(tmp_path)]) == status
    assert ("other scores than the penalties" in capsys.readouterr().err) == bool(status)


def test_a_check_says_what_its_numbers_say(tmp_path: Path, capsys) -> None:
    entry = make_entry(complete_results())
    add_entries(tmp_path, [entry.results])
    command = ["leaderboard", "check", "--entries", str(tmp_path)]
    for check, wrong in (
        (check_of(entry), {"verdict": "differs"}),
        (check_of(entry), {"differences": 2}),
        (check_of(entry), {"frames": 10**6}),
        (check_of(entry, "re-run"), {"verdict": "differs"}),
        (check_of(entry, "re-run", "differs"), {"verdict": "reproduces"}),
        (check_of(entry, "re-run"), {"same_predictions": 3}),
    ):
        file = write_check(tmp_path, check)
        assert main(command) == 0
        file.unlink()
        file = write_check(tmp_path, replace(check, **wrong))
        assert main(command) == 1, wrong
        assert "checks, " in capsys.readouterr().err
        file.unlink()


def test_the_data_of_a_table_are_those_that_were_checked_or_that_most_have() -> None:
    """Suites whose digests are not known: the majority counts, and a check more than any."""

    def row(name: str, data: str):
        results = complete_results(name)
        captures = [replace(c, digest=data * 64) for c in results.captures]
        return make_entry(replace(results, captures=captures))

    false, first, second = row("a", "0"), row("b", "1"), row("c", "1")
    assert off_the_data([false, first, second]) == [(false, first.name)]
    assert off_the_data([false, first]) == [(first, false.name)]
    checked = replace(first, checks=(check_of(first),))
    assert off_the_data([false, checked]) == [(false, first.name)]


def test_a_folder_without_entries_is_not_sound(tmp_path: Path, capsys) -> None:
    for place in (tmp_path, tmp_path / "nowhere"):
        for words in (["check"], ["show"], ["build", "-o", str(tmp_path / "site")]):
            assert main(["leaderboard", *words, "--entries", str(place)]) == 2
            assert "--entries: " in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


def test_a_result_that_was_changed_by_hand_is_not_added(tmp_path: Path, capsys) -> None:
    run, entries = tmp_path / "run", tmp_path / "entries"
    file = write_results(run / "results.json", complete_results())
    text = file.read_text()
    add = ["dev", "leaderboard", "add", str(run), "--entries", str(entries)]
    submit = ["leaderboard", "submit", str(run), "-o", str(tmp_path / "s"), "--entries"]
    file.write_text(text.replace('"fit_seconds": 2.0', '"fit_seconds": 1.0'))
    for words in (add, [*submit, str(entries)]):
        assert main(words) == 1
        assert "changed by hand" in capsys.readouterr().err
    file.write_text(text)
    copy = run / "captures" / "capture0" / "result.json"
    copy.parent.mkdir(parents=True)
    record = json.loads(text)["captures"][0]
    copy.write_text(json.dumps({**record, "steps": 11}))
    assert main(add) == 1
    assert "capture0, result.json, steps: was changed by hand" in capsys.readouterr().err
    copy.write_text(json.dumps(record))
    assert main(add) == 0
    assert len(read_entries(entries)) == 1


def test_the_digests_of_suites_are_those_of_rendered_captures(tmp_path: Path) -> None:
    """Oracle: the renderer, as far as captures of suites are in the cache of this machine."""
    known = read_suite_data()
    assert known.renderer == RENDERER
    assert {"smoke", "mini", "full-lite"} <= known.suites.keys()
    here = rendered_data(cache_root() / "sim" / "captures")
    for suite, captures in here.suites.items():
        for name, data in captures.items():
            listed = known.suites.get(suite, {}).get(name)
            if listed is not None and listed.current is not None:
                assert data.current is not None
                accepted = {one.digest for one in (listed.current, *listed.others)}
                assert data.current.digest in accepted, (suite, name)
    assert read_suite_data(write_suite_data(tmp_path / "suites.json", known)) == known


def _data(letter: str, *former: str) -> CaptureData:
    first, *others = (Version(one * 64, one * 64) for one in (letter, *former))
    return CaptureData(first, tuple(others))


def test_a_cache_without_a_suite_takes_nothing_away() -> None:
    known = read_suite_data()
    joined = joined_data(known, SuiteData({"mini": {"capture0": _data("a")}})).suites
    assert joined["smoke"] == known.suites["smoke"]
    new = replace(_data("a"), former=known.suites["mini"]["capture0"].former)
    assert joined["mini"] == {**known.suites["mini"], "capture0": new}


def test_data_of_a_renderer_that_rounds_otherwise_become_former() -> None:
    data = SuiteData({"mini": {"capture0": _data("a"), "capture1": _data("b")}}, renderer=1)
    for renderer in (2, 2):
        rendered = SuiteData({"mini": {"capture0": _data("c")}}, renderer)
        data = joined_data(data, rendered, rounding=True)
        assert data.suites["mini"]["capture0"] == _data("c", "a")
        assert data.suites["mini"]["capture1"] == CaptureData(None, _data("b").versions)
    third = SuiteData({"mini": {"capture1": _data("d")}}, 3)
    found = joined_data(data, third, rounding=True)
    assert found.suites["mini"]["capture0"] == CaptureData(None, _data("c", "a").versions)
    assert found.suites["mini"]["capture1"] == _data("d", "b")
    # A renderer that makes other pixels leaves nothing of before.
    assert joined_data(data, third) == third


def test_another_processor_has_digests_beside_those_that_are_known() -> None:
    known = SuiteData({"mini": {"capture0": _data("a", "f"), "capture1": _data("b")}})
    here = SuiteData({"mini": {"capture0": _data("c"), "capture1": _data("b")}})
    joined = joined_data(known, here, processor="AMD", levels=2).suites["mini"]
    assert joined["capture0"].current == known.suites["mini"]["capture0"].current
    (other,) = joined["capture0"].others
    assert (other.digest, other.processor, other.levels) == ("c" * 64, "AMD", 2)
    assert [one.digest[0] for one in joined["capture0"].versions] == ["a", "c", "f"]
    assert joined["capture1"] == _data("b")
    again = joined_data(SuiteData({"mini": joined}), here, processor="AMD", levels=3)
    assert [one.levels for one in again.suites["mini"]["capture0"].others] == [3]


@pytest.mark.parametrize(("levels", "paired"), [(2, True), (12, False), (None, False)])
def test_results_of_other_processors_pair_within_the_stated_difference(
    levels: int | None, paired: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Version("c" * 64, None, "AMD", levels)
    data = replace(_data("a"), others=(other,))
    known = SuiteData({"smoke": {"capture0": data}})
    monkeypatch.setattr("hwp_bench.leaderboard.suite_data.known_data", lambda: known)
    results = complete_results()
    captures = [replace(one, digest=other.digest) for one in results.captures]
    found = on_current_data(replace(results, captures=captures)).captures[0]
    assert found.digest == ("a" if paired else "c") * 64


def _renewed(monkeypatch: pytest.MonkeyPatch, *, rendered: bool) -> SuiteData:
    """The suite `smoke` after a new renderer, which was used or not yet; what ships is former."""
    renewed = {}
    for letter, (name, data) in zip("ab", read_suite_data().suites["smoke"].items(), strict=True):
        current = Version(letter * 64) if rendered else None
        renewed[name] = CaptureData(current, data.versions)
    data = SuiteData({"smoke": renewed})
    for module in ("suite_data", "rules"):
        monkeypatch.setattr(f"hwp_bench.leaderboard.{module}.known_data", lambda: data)
    return data


def test_entries_on_data_that_were_rounded_otherwise_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the rank that two entries on the same data have."""
    before, after = complete_results("before", 20.0), complete_results("after", 21.0)
    data = _renewed(monkeypatch, rendered=True).suites["smoke"]
    captures = [replace(c, digest=data[c.id].versions[0].digest) for c in after.captures]
    after = with_keys(replace(after, captures=captures))
    add_entries(tmp_path, [before])
    add_entries(tmp_path, [after])
    assert on_current_data(before).captures[0].digest == "a" * 64
    assert on_current_data(after) == after
    methods = method_rows(sound_entries(tmp_path))
    ranks, sentence = ranks_of(methods)
    assert "+1.00 dB against Before" in sentence
    assert {row.first.method.name: ranks[row.entries[0].name].rank for row in methods} == {
        "after": 1,
        "before": 2,
    }


def test_a_suite_that_was_not_rendered_yet_binds_no_new_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = complete_results("before")
    _renewed(monkeypatch, rendered=False)
    assert on_current_data(before) == before
    add_entries(tmp_path / "old", [before])
    captures = [replace(c, digest="c" * 64) for c in before.captures]
    add_entries(tmp_path / "new", [with_keys(replace(before, captures=captures))])
    assert len(sound_entries(tmp_path / "old")) == len(sound_entries(tmp_path / "new")) == 1


@pytest.mark.parametrize(
    ("started", "checked", "problem"),
    [
        ("2099-01-01T00:00:00+00:00", None, "which is not yet"),
        ("2026-01-02T00:00:00+00:00", "2099-01-01T00:00:00+00:00", "which is not yet"),
        ("2026-01-02T00:00:00+00:00", "2026-01-01T00:00:00+00:00", "its run"),
    ],
)
def test_false_dates_are_refused(started: str, checked: str | None, problem: str) -> None:
    entry = make_entry(replace(complete_results("mine"), started=started))
    if checked:
        entry = replace(entry, checks=(replace(check_of(entry), date=checked),))
    with pytest.raises(BadResult, match=problem):
        check_dates(entry)
    check_dates(make_entry(complete_results("mine")))


def test_an_entry_of_no_day_is_left_out_alone(tmp_path: Path, capsys) -> None:
    add_entries(tmp_path, [complete_results("mine")])
    for name, started in (("other", "2026-02-30T00:00:00+00:00"), ("third", "yesterday")):
        write_entry(tmp_path, make_entry(replace(complete_results(name), started=started)))
    assert [entry.results.method.name for entry in sound_entries(tmp_path)] == ["mine"]
    said = capsys.readouterr().err
    assert "is 2026-02-30T00:00:00+00:00, which is not a moment" in said
    assert "started: is 'yesterday', expected a moment such as" in said


def test_a_false_check_is_left_out_and_takes_no_row_away(tmp_path: Path, capsys) -> None:
    (file,) = add_entries(tmp_path, [complete_results("mine")])
    (entry,) = read_entries(tmp_path)
    for check in (
        replace(check_of(entry, "re-run"), date="2099-01-01T00:00:00+00:00"),
        replace(check_of(entry), frames=10**6),
        replace(check_of(entry), overrules=["0" * 64], reason="none"),
    ):
        written = write_check(tmp_path, check)
        (read,) = sound_entries(tmp_path)
        assert (read.name, read.checks) == (file.stem, ())
        assert "left out: " in capsys.readouterr().err
        assert main(["leaderboard", "check", "--entries", str(tmp_path)]) == 1
        written.unlink()


@pytest.mark.parametrize(
    ("name", "title"),
    [("wildghand", "Mine"), ("mine", "WildGHand"), ("mine", "WiIdGHand"), ("Plain", "P"),
     ("mine", "Wild G-Hand"), ("mine", "PLAIN FIT"), ("w1ldghand", "Mine"),
     ("mine", "WildGH\u0430nd"), ("mine", "\u0420lain fit"), ("mine", "WildGHa\u039dd")],
)  # fmt: skip
def test_the_name_of_a_method_that_ships_is_nobody_elses(
    tmp_path: Path, name: str, title: str
) -> None:
    results = complete_results(name, 60.0)
    results = with_keys(replace(results, method=replace(results.method, title=title)))
    entry = make_entry(results)
    folder = tmp_path / "entries"
    write_entry(folder, entry)
    assert sound_entries(folder) == []
    assert main(["leaderboard", "check", "--entries", str(folder)]) == 2
    with pytest.raises(UsageError, match="a method that ships"):
        check_names([entry], frozenset())
    assert register(folder, [entry]) == [entry]
    assert [one.name for one in sound_entries(folder)] == [entry.name]


def test_a_revision_of_somebody_elses_row_is_a_row_of_its_own(tmp_path: Path, capsys) -> None:
    mine = make_entry(complete_results("mine", 24.0), Submission(by="A"))
    why = Submission(by="B", revises=mine.name, reason="better")
    theirs = make_entry(complete_results("mine", 5.0), why)
    for entry in (mine, theirs):
        write_entry(tmp_path, entry)
    write_check(tmp_path, check_of(mine))
    assert main(["leaderboard", "check", "--entries", str(tmp_path)]) == 2
    assert "which somebody else stands for" in capsys.readouterr().err
    labels = {m.label: m.level for m in method_rows(sound_entries(tmp_path))}
    assert labels == {"Mine (by A)": "rescored", "Mine (by B)": "self-reported"}


def test_a_second_run_has_the_files_of_the_first_at_any_place() -> None:
    def ran(place: str, letter: str, hour: int) -> Results:
        base = complete_results("mine", started=f"2026-01-01T0{hour}:00:00+00:00")
        method = replace(base.method, settings={"regions": f"sam:{place}"})
        captures = [replace(one, exposed=letter * 64) for one in base.captures]
        return replace(base, method=method, captures=captures)

    first = ran("/home/a/sam.pth", "a", 1)
    assert repeats(first, ran("/srv/sam.pth", "a", 2))
    assert not repeats(first, ran("/home/a/sam.pth", "b", 2))
