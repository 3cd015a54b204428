"""`evaluate` with several methods and seeds, and seconds without steps.

Oracle: the same evaluations one by one, whose methods make errors that are known.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from small_captures import CaptureMaker
from toy_method import write_toy_method

from hwp_bench.base.errors import UsageError
from hwp_bench.cli.main import main
from hwp_bench.evaluation.evaluate import make_budget
from hwp_bench.methods.contract import Budget
from hwp_bench.results import read_all, read_results


@pytest.fixture
def words(make_capture: CaptureMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Two toy methods, `toy` and `bare`, which is 30 levels worse, on one capture."""
    monkeypatch.chdir(tmp_path)
    bare = write_toy_method(tmp_path / "bare") / "method.toml"
    text = bare.read_text().replace('"toy"', '"bare"').replace('"Toy"', '"Bare"')
    bare.write_text(text.replace("tone = true", "tone = false"))
    toy = write_toy_method(tmp_path / "toy") / "method.toml"
    toy.write_text('validation = ["shape", "settings"]\n' + toy.read_text())
    capture = make_capture(frames=20).root
    # The toy notes its fits next to its folder.
    return ["evaluate", "toy", "bare", "--capture", str(capture), "--isolation", "none"]


def fits(tmp_path: Path) -> int:
    return len((tmp_path / "fits.log").read_text().splitlines())


def test_each_method_and_seed_has_a_folder_and_one_table_compares_them(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--seeds", "2", "-o", "field"]) == 0
    told = capsys.readouterr()
    assert "Toy, seed 0, 1 of 4" in told.err
    assert "Bare, seed 1, 4 of 4" in told.err
    assert told.out.count("Ranks by") == 1
    assert "Toy: shape, settings; Bare: not declared" in told.out.replace("\n", " ")
    folders = [f"{method}/seed-{seed}" for method in ("bare", "toy") for seed in (0, 1)]
    found = sorted(file.parent.relative_to("field") for file in Path("field").rglob("results.json"))
    assert [str(folder) for folder in found] == folders
    for folder, results in zip(folders, read_all(["field"]), strict=True):
        assert folder == f"{results.method.name}/seed-{results.seed}"
    # As one evaluation by itself.
    assert main([*words[:2], *words[3:], "--seed", "1", "-o", "alone"]) == 0
    alone, several = read_results("alone"), read_results("field/toy/seed-1")
    assert alone.captures[0].key == several.captures[0].key
    assert alone.captures[0].frames == several.captures[0].frames
    assert alone.method.validation == ["shape", "settings"]
    capsys.readouterr()
    for command in (["table", "field", "--by", "seeds"], ["compare", "field"]):
        assert main(command) == 0
        shown = capsys.readouterr().out
        assert "Toy" in shown
        assert "Bare" in shown


def test_it_goes_on_where_it_was_stopped(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words[:2], *words[3:], "--seeds", "2", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["results"] == [f"runs/field-captures/toy/seed-{s}/results.json" for s in (0, 1)]
    assert value["table"]["rows"][0]["Seeds"] == 2
    assert fits(tmp_path) == 2
    assert main([*words, "--seeds", "2", "--json"]) == 0
    table = json.loads(capsys.readouterr().out)["table"]
    assert [row["Method"] for row in table["rows"]] == ["Toy", "Bare"]
    assert fits(tmp_path) == 4
    with pytest.raises(SystemExit):
        main([*words, "--seed", "1", "--seeds", "2"])


def test_what_fails_is_said_and_the_others_are_compared(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("bare/run.py").write_text("import sys\nsys.exit('no luck')\n")
    assert main([*words, "-o", "field"]) == 1
    told = capsys.readouterr()
    assert "Bare, seed 0" in told.err
    assert "no luck" in told.err
    assert "Toy" in told.out


def test_what_cannot_be_made_is_left_out_with_every_seed(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    file = Path("bare/method.toml")
    file.write_text(file.read_text().replace("{python}", "no-such-program"))
    assert main([*words, "--seeds", "2", "-o", "field"]) == 1
    assert capsys.readouterr().err.count("not evaluated") == 2
    assert [str(file.parent) for file in sorted(Path("field").rglob("results.json"))] == [
        "field/toy/seed-0",
        "field/toy/seed-1",
    ]


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        (["toy"], "'toy' is the name of two"),
        (["--seeds", "0"], "0 is not between"),
        (["no"], "no:"),
    ],
)
def test_a_wrong_call_is_refused_before_anything_runs(
    words: list[str], tmp_path: Path, more: list[str], problem: str, capsys
) -> None:
    given = [*words[:3], *more, *words[3:]] if more[0] != "--seeds" else [*words, *more]
    assert main(given) != 0
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "fits.log").exists()
    assert not (tmp_path / "runs").exists()


def test_seconds_alone_lift_the_limit_of_steps_and_results_say_so(words: list[str]) -> None:
    assert make_budget(None, None) == Budget()
    assert make_budget(None, 7) == Budget(steps=7)
    assert make_budget(16.0, 7) == Budget(16.0, 7)
    assert make_budget(16.0, None) == make_budget(16.0, 100_000) == Budget(16.0, 100_000)
    assert make_budget(3600.0, None) == Budget(3600.0, 3_600_000)
    with pytest.raises(UsageError, match="seconds"):
        make_budget(float("inf"), None)
    assert main([words[0], *words[2:], "--budget", "16"]) == 0
    assert read_results("runs/bare-captures-16s").budget == {"seconds": 16.0, "steps": 100_000}
