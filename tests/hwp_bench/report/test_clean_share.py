"""Scores over the share of clean training frames. Oracle: by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.cli.main import main
from hwp_bench.report.clean_share import (
    clean_share_of,
    clean_share_table,
    draw_clean_share,
    scores_by_share,
    write_clean_share,
)
from hwp_bench.results import Results, write_results


@pytest.fixture
def study(make_results, make_capture) -> tuple[list[Results], dict]:
    """Two methods on captures at two shares; each result has frames of `psnr` and one more."""
    info = make_capture("capture2").info
    results, captures = [], {}
    for suite, share, scores in (("few", 0.1, (20, 23)), ("many", 0.6, (26, 27))):
        digest = f"{int(100 * share):064x}"
        captures[digest] = replace(info, source={"kind": "simulated", "clean_share": share})
        for name, psnr in zip(("plain", "mine"), scores, strict=True):
            made = make_results(name, psnr)
            scored = [replace(made.captures[0], digest=digest)]
            results.append(replace(made, suite=suite, captures=scored))
    return results, captures


def test_a_method_is_one_curve_over_its_suites(study) -> None:
    results, captures = study
    found = scores_by_share(results, captures, "psnr")
    assert [(one.share, one.score.value) for one in found] == [
        (0.1, pytest.approx(20.5)),
        (0.1, pytest.approx(23.5)),
        (0.6, pytest.approx(26.5)),
        (0.6, pytest.approx(27.5)),
    ]
    labels = [one.label for one in found]
    assert labels[:2] == labels[2:]
    assert labels[0] != labels[1]
    assert [one.behind and one.behind.value for one in found] == [
        None,
        pytest.approx(3.0),
        None,
        pytest.approx(1.0),
    ]
    # A difference that is the same in every frame has no spread, the score has one.
    assert found[1].behind is not None
    assert (found[1].behind.low, found[1].behind.high) in {(None, None), (3.0, 3.0)}
    shown = [(row[0], row[8], row[9]) for row in clean_share_table(results, captures).rows]
    assert shown == [(10, 1, 1), (10, 1, 1), (60, 1, 1), (60, 1, 1)]


def test_a_figure_adds_nothing_to_the_table_and_repeats_are_left_out(
    study, tmp_path, capsys, monkeypatch
) -> None:
    results, captures = study
    for number, result in enumerate([*results, results[0]]):
        write_results(tmp_path / str(number) / "results.json", result)
    for module in ("requested_table", "sources"):
        monkeypatch.setattr(f"hwp_bench.report.{module}.find_captures", lambda *_: captures)
    words = ["table", *(str(tmp_path / str(number)) for number in range(5)), "--by", "clean-share"]
    assert main([*words, "--figure", str(tmp_path / "figures"), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["rows"]) == 4
    assert (tmp_path / "figures" / "clean-share.png").is_file()


def test_only_scores_of_the_same_seeds_are_paired(study) -> None:
    results, captures = study
    # Method `mine` has as many seeds as the first at 10 %, but another one.
    results[1] = replace(results[1], seed=1)
    found = scores_by_share(results, captures, "psnr")
    differences = [one.behind and one.behind.value for one in found]
    assert differences == [None, None, None, pytest.approx(1.0)]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda r: replace(r, frames="clean"), "different training frames"),
        (lambda r: replace(r, protocols={"other": {}}), "different protocols"),
        (lambda r: _first(r, frames=r.captures[0].frames[1:]), "different test frames"),
        (lambda r: _first(r, split_digest="9" * 64), "different splits"),
        (lambda r: _first(r, exact_masks=not r.captures[0].exact_masks), "different masks"),
    ],
)
def test_what_compare_refuses_is_refused(study, change, problem: str) -> None:
    results, captures = study
    results[1] = change(results[1])
    with pytest.raises(UsageError, match=problem):
        scores_by_share(results, captures, "psnr")


def _first(result: Results, **changes: object) -> Results:
    return replace(result, captures=[replace(result.captures[0], **changes)])


def test_captures_of_no_suite_are_told_apart_by_their_digests(study) -> None:
    results, captures = study
    named = scores_by_share(results, captures, "psnr")
    unnamed = scores_by_share([replace(one, suite="captures") for one in results], captures, "psnr")
    assert [(one.share, one.score.value) for one in unnamed] == [
        (one.share, one.score.value) for one in named
    ]


def test_a_share_is_said_or_counted(make_capture) -> None:
    # Of 20 frames 16 are trained on, of which frames 1, 5, 9 and 13 are blurred.
    info = make_capture("capture2").info
    assert clean_share_of(info) == pytest.approx(12 / 16)
    assert clean_share_of(replace(info, source={"clean_share": 0.2})) == 0.2
    assert clean_share_of(replace(info, perturbations={"motion_blur": None})) is None
    assert clean_share_of(replace(info, perturbations={})) == 1.0


def test_unknown_shares_are_refused(study) -> None:
    with pytest.raises(UsageError, match="share of clean training frames of none"):
        scores_by_share(study[0], {}, "psnr")


def test_the_command_prints_it_and_the_figure_has_every_method(study, tmp_path, capsys) -> None:
    results, captures = study
    for number, result in enumerate(results):
        write_results(tmp_path / str(number) / "results.json", result)
    # Captures that are nowhere on this machine.
    folders = [str(tmp_path / str(number)) for number in range(4)]
    assert main(["table", *folders, "--by", "clean-share"]) == 2
    assert "render the suite" in capsys.readouterr().err
    figure = draw_clean_share(scores_by_share(results, captures, "psnr"), "psnr")
    written = write_clean_share(tmp_path, results, captures)
    assert [path.suffix for path in written] == [".png", ".svg"]
    (axes,) = figure.axes
    curves = [
        line for line in axes.lines if len(line.get_xdata()) == 2 and line.get_marker() != "o"
    ]
    assert [list(line.get_ydata()) for line in curves] == [[20.5, 26.5], [23.5, 27.5]]
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["10 %", "60 %"]


def test_a_score_is_the_mean_over_the_captures_of_its_share(make_results, make_capture) -> None:
    info = make_capture("capture2").info
    captures = {digit * 64: replace(info, source={"clean_share": 0.1}) for digit in "12"}
    results = []
    for name, levels in (("plain", (20, 30)), ("mine", (21, 34))):
        own = [
            replace(make_results(name, level).captures[0], id=f"c{number}", digest=digest)
            for number, (level, digest) in enumerate(zip(levels, captures, strict=True))
        ]
        results.append(replace(make_results(name), suite="few", captures=own))
    plain, mine = scores_by_share(results, captures, "psnr")
    # Frames of `level` and one more: 20.5, 30.5 and 21.5, 34.5.
    assert (plain.score.value, plain.score.captures) == (pytest.approx(25.5), 2)
    assert (mine.score.value, mine.score.captures) == (pytest.approx(28.0), 2)
    assert mine.behind is not None
    assert (mine.behind.value, mine.behind.captures) == (pytest.approx(2.5), 2)
