"""Accuracy against time. Oracles: curves whose scores and times are known by construction."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_results import made_results

from hwp_bench.analysis.cost import analyse_cost, method_costs, run_seconds, seconds_table
from hwp_bench.analysis.curves import Curve, curve_of, mean_curve, pareto_front
from hwp_bench.analysis.pairing import group_runs
from hwp_bench.base.errors import UsageError
from hwp_bench.cli.main import main
from hwp_bench.results import CurvePoint, write_results


def flat(capture: int, frame: int, seed: int) -> float:
    return 20.0


def doubling(name: str, start: float = 20.0, count: int = 5, **more: object):
    """A method that gains 1 dB at 1, 2, 4, ... s."""
    curve = [(2.0**k, start + k) for k in range(count)]
    return made_results(name, flat, curve=curve, seconds=curve[-1][0], steps=160, **more)


CURVE = Curve(np.array([1.0, 2, 4, 8, 16]), np.array([20.0, 21, 22, 23, 24]))


def test_a_curve_is_linear_in_log_time() -> None:
    assert CURVE.at(np.array([1.0, 2.0, 8 * math.sqrt(2), 16, 100])) == pytest.approx(
        [20, 21, 23.5, 24, 24]
    )
    assert math.isnan(CURVE.at(0.5))
    assert CURVE.time_to(22.5, True) == pytest.approx(4 * math.sqrt(2))
    assert CURVE.time_to(19.0, True) == 1.0
    assert CURVE.time_to(24.1, True) == math.inf
    assert CURVE.log_area(1, 16) == pytest.approx(22)
    assert CURVE.log_area(16, 64) == pytest.approx(24)
    falling = Curve(CURVE.seconds, 1 - CURVE.scores / 100)
    assert falling.time_to(1 - 0.225, False) == pytest.approx(4 * math.sqrt(2))


@given(
    st.lists(st.floats(0.01, 1000), min_size=2, max_size=8, unique=True),
    st.data(),
)
def test_a_score_is_reached_when_the_curve_says_so(moments: list[float], data) -> None:
    scores = data.draw(st.lists(st.floats(0, 50), min_size=len(moments), max_size=len(moments)))
    curve = Curve(np.array(sorted(moments)), np.array(scores))
    target = data.draw(st.floats(0, 50))
    when = curve.time_to(target, True)
    if math.isinf(when):
        assert max(scores) < target
    else:
        assert curve.seconds[0] <= when <= curve.seconds[-1] * (1 + 1e-9)
        # At that moment or, for the rounding of its logarithm, just after it: a curve may fall at
        # once, to the next checkpoint.
        just_after = min(when * (1 + 1e-12), curve.seconds[-1])
        assert curve.at(np.array([when, just_after])).max() >= target - 1e-3


def test_checkpoints_at_one_moment_count_once() -> None:
    capture = made_results("mine", flat, curve=[(0.0, 1.0), (0.0, 2.0), (5.0, 3.0)]).captures[0]
    curve = curve_of(capture, "psnr")
    assert curve.seconds.tolist() == [0.001, 5.0]
    assert curve.scores.tolist() == [2.0, 3.0]
    assert curve_of(capture, "ssim") is None
    assert curve_of(replace(capture, curve=[]), "psnr") is None


def test_costs_of_known_curves() -> None:
    runs = group_runs([doubling("mine"), doubling("plain", 19.0, 4)])
    mine, plain = method_costs(runs, "psnr", budgets=(4.0, 5.0, 300.0), reference=runs[1])
    assert (mine.final, plain.final) == (24.0, 22.0)
    # No fit lasts 300 s; plain has ended at 8 s.
    assert mine.at == pytest.approx({4.0: 22.0, 5.0: 22 + math.log2(5 / 4)})
    assert (mine.to_reference.seconds, mine.to_reference.reached) == (pytest.approx(4.0), 4)
    assert plain.to_reference.seconds == pytest.approx(8.0)
    assert mine.to_own[0.5].seconds == pytest.approx(16 / math.sqrt(2))
    assert mine.to_own[0.1].seconds == pytest.approx(16 / 2**0.1)
    assert mine.area == pytest.approx(22.0)
    # 19, 20, 21, 22 dB at 1 to 8 s, then 22 dB until the longer fit has ended.
    assert plain.area == pytest.approx((19.5 + 20.5 + 21.5 + 22) / 4)
    assert (mine.fit_seconds, mine.steps, mine.peak_memory) == (16.0, 160.0, 10**8)
    assert mine.frames_per_second == pytest.approx(12)
    assert mine.score_seconds == pytest.approx(0.1 / 6)
    assert (mine.curves, mine.fits, mine.devices) == (4, 4, ("cpu",))


def test_the_seconds_of_a_run_are_its_parts() -> None:
    base = made_results("mine", flat, captures=1).captures[0]
    capture = replace(
        base, fit_seconds=6.0, curve_seconds=1.5, render_seconds=0.5, wall_seconds=11.0,
        job_seconds=12.5,
    )  # fmt: skip
    parts = {"start": 3.0, "fit": 6.0, "curve": 1.5, "render": 0.5, "score": 1.5}
    assert run_seconds(capture) == pytest.approx(parts)
    assert run_seconds(replace(capture, job_seconds=None)) is None
    # A method that says more than its process took: nothing becomes negative.
    assert run_seconds(replace(capture, fit_seconds=60.0))["start"] == 0.0
    whole = replace(made_results("mine", flat), captures=[capture, capture, base])
    table = seconds_table(group_runs([whole]))
    found = {row[0]: row[1:4] for row in table.rows}
    assert found["curve"] == pytest.approx((1.5, 3.0, 12.0))
    assert found["sum"] == pytest.approx((12.5, 25.0, 100.0))
    assert "1 of 3 runs do not record it." in table.notes
    assert seconds_table(group_runs([doubling("old")])) is None


def test_a_score_that_most_fits_never_reach_has_no_time() -> None:
    runs = group_runs([doubling("mine", 10.0), doubling("plain")])
    found = method_costs(runs, "psnr", reference=runs[1])[0].to_reference
    assert (found.seconds, found.reached, found.fits) == (None, 0, 4)
    assert method_costs(runs, "psnr")[0].to_reference is None


def test_the_front_goes_from_the_quick_to_the_good() -> None:
    # The quick one is ahead until both have 22.5 dB.
    quick = {"c": [Curve(np.array([1.0, 2.0]), np.array([22.0, 22.5]))]}
    curves = [mean_curve("good", {"c": [CURVE]}), mean_curve("quick", quick)]
    front = pareto_front(curves, True)
    assert [part.label for part in front] == ["quick", "good"]
    assert (front[0].start, front[0].stop) == (1.0, 2.0)
    assert front[1].start == pytest.approx(4 * math.sqrt(2), rel=0.02)
    assert (front[1].stop, front[1].last_score) == (16.0, 24.0)
    worse = mean_curve("worse", {"c": [Curve(CURVE.seconds, CURVE.scores - 1)]})
    assert {part.label for part in pareto_front([curves[0], worse], True)} == {"good"}
    assert {part.label for part in pareto_front([curves[0], worse], False)} == {"worse"}
    assert pareto_front([], True) == []


def test_the_band_is_students_interval_over_captures() -> None:
    """Oracle: scipy's interval of the captures' final scores."""
    from scipy import stats

    finals = [20.0, 22.0, 27.0]
    curves = {
        str(i): [Curve(np.array([1.0, 4.0]), np.array([10.0, value]))]
        for i, value in enumerate(finals)
    }
    curve = mean_curve("mine", curves)
    low, high = stats.t.interval(0.95, 2, np.mean(finals), stats.sem(finals))
    assert (curve.low[-1], curve.high[-1]) == (pytest.approx(low), pytest.approx(high))
    for few in ({"c": [CURVE]}, {"c": [CURVE], "d": [CURVE]}):
        assert mean_curve("mine", few).low is None
    assert mean_curve("mine", {}) is None


def test_the_plain_baseline_is_the_reference_where_it_is_there() -> None:
    runs = group_runs([doubling("mine"), doubling("plain", 19.0, 4)])
    heads = [column.title for column in analyse_cost(runs, "psnr").tables["cost"].columns]
    assert "To final of Plain" in heads
    heads = [column.title for column in analyse_cost(runs[:1], "psnr").tables["cost"].columns]
    assert not any(title.startswith("To final") for title in heads)


def test_failed_fits_and_other_machines_are_named() -> None:
    other = doubling("plain", environment={"processor": "fast", "cores": 64})
    lost = replace(other, captures=[replace(other.captures[0], curve=[]), *other.captures[1:]])
    notes = analyse_cost(group_runs([doubling("mine"), lost]), "psnr").tables["cost"].notes
    assert "Fits without a curve, left out: Plain: 1." in notes
    assert any("the seconds do not compare" in note for note in notes)


def test_the_command_prints_writes_and_refuses(tmp_path: Path, capsys) -> None:
    for name, start in (("mine", 20.0), ("plain", 19.0)):
        write_results(tmp_path / name / "results.json", doubling(name, start))
    mine, plain, out = (str(tmp_path / name) for name in ("mine", "plain", "out"))
    assert main(["curves", mine, plain, "-o", out]) == 0
    shown = capsys.readouterr()
    assert "Accuracy against time" in shown.out
    assert "pareto.svg" in shown.err
    assert main(["curves", mine, "--reference", plain, "-o", out, "--budgets", "3", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["methods"][0]["to_reference"]["seconds"] == pytest.approx(8.0)
    assert list(value["methods"][0]["at"]) == ["3.0"]
    assert value["curves"][0]["scores"][-1] == 24.0
    assert main(["curves", mine, "--budgets", "-1", "-o", out]) == 2
    assert main(["curves", mine, "--metric", "ssim", "-o", out]) == 2
    assert "no result has a curve of ssim" in capsys.readouterr().err
    write_results(tmp_path / "few" / "results.json", doubling("few", captures=2))
    # Other data are analysed apart, and are no reference.
    few, bare = str(tmp_path / "few"), str(tmp_path / "bare")
    assert main(["curves", mine, few, "-o", out]) == 0
    shown = capsys.readouterr().out
    assert "Data A: Accuracy against time" in shown
    assert "Data B: Accuracy against time" in shown
    assert {path.name for path in Path(out, "B").iterdir()} >= {"pareto.svg", "pareto.png"}
    assert main(["curves", mine, "--reference", few, "-o", out]) == 2
    assert "not evaluated on the same captures" in capsys.readouterr().err
    write_results(tmp_path / "one" / "results.json", doubling("one", captures=1))
    assert main(["curves", mine, few, "--reference", str(tmp_path / "one"), "-o", out]) == 2
    assert "on other data than every result" in capsys.readouterr().err
    # Data without a curve are named and left out.
    write_results(
        tmp_path / "bare" / "results.json", made_results("bare", flat, captures=3, curve=[])
    )
    assert main(["curves", mine, bare, "-o", out]) == 0
    assert "data B: metric: no result has a curve of psnr" in " ".join(
        capsys.readouterr().err.split()
    )
    assert main(["curves", bare, "-o", out]) == 2


def test_a_fit_of_one_checkpoint_is_a_point() -> None:
    single = doubling("mine", count=1)
    analysis = analyse_cost(group_runs([single]), "psnr")
    assert analysis.costs[0].area is None
    assert analysis.curves[0].seconds.tolist() == [1.0]
    assert [part.label for part in analysis.front] == ["Mine"]
    bare = replace(
        single, captures=[replace(c, curve=[CurvePoint(1, 1.0, 0, {})]) for c in single.captures]
    )
    with pytest.raises(UsageError, match="no result has a curve of psnr"):
        analyse_cost(group_runs([bare]), "psnr")


def with_curves(name: str, curves: list[list[tuple[float, float]]]):
    """A method with a curve of its own on each capture."""
    base = made_results(name, flat)
    rows = [
        replace(c, curve=[CurvePoint(k, t, 10**8, {"psnr": v}) for k, (t, v) in enumerate(one)])
        for c, one in zip(base.captures, curves, strict=True)
    ]
    return replace(base, captures=rows)


def test_the_reference_is_reached_capture_by_capture_by_half_of_the_fits() -> None:
    plain = with_curves("plain", [[(1.0, score)] for score in (20.0, 22.0, 30.0, 30.0)])
    # After 2 s, 4 s, never and never.
    ends = ((2.0, 20.0, 20.0), (4.0, 22.0, 22.0))
    curves = [[(1.0, 10.0), (time, score), (16.0, last)] for time, score, last in ends]
    curves += 2 * [[(1.0, 10.0), (16.0, 29.0)]]
    runs = group_runs([with_curves("mine", curves), plain])
    found = method_costs(runs, "psnr", reference=runs[1])[0].to_reference
    assert found is not None
    assert (found.seconds, found.reached, found.fits) == (pytest.approx(4.0), 2, 4)


def test_times_and_memory_by_hand() -> None:
    made = doubling("mine")  # 16 s and 160 steps; 0.5 s for 6 frames drawn, 0.1 s scored
    first = replace(made.captures[0], peak_memory=3 * 10**8)
    made = replace(made, captures=[first, *made.captures[1:]])
    table = analyse_cost(group_runs([made]), "psnr").tables["times"]
    row = dict(zip([column.title for column in table.columns], table.rows[0], strict=True))
    assert (row["Fit [s]"], row["Steps"], row["Whole process [s]"]) == (16.0, 160.0, 4.0)
    assert row["Step [ms]"] == pytest.approx(100.0)
    assert row["Render [ms/frame]"] == pytest.approx(500 / 6)
    assert row["Score [ms/frame]"] == pytest.approx(100 / 6)
    assert row["Peak memory [GB]"] == pytest.approx(0.3)
