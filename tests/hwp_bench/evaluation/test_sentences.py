"""An outcome in words names every bad frame, up to a bound, and counts the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from small_captures import results_example

from hwp_bench.evaluation.sentences import SHOWN, failure_text, outcome_lines
from hwp_bench.results import FrameResult


def _capture(failures: list[str | None]):
    frames = [FrameResult(i, {"psnr": 0.0}, text) for i, text in enumerate(failures)]
    return replace(results_example().captures[0], frames=frames)


def test_every_bad_frame_is_named_with_its_reason() -> None:
    text = failure_text(
        _capture(
            [None, "000001.png: is empty", "000002.png: does not exist", "000003.png: is empty"]
        )
    )
    assert text == (
        "capture2: 3 of 4 frames: 000001.png, 000003.png: is empty; 000002.png: does not exist"
    )


def test_many_bad_frames_are_bounded_and_counted() -> None:
    text = failure_text(_capture([f"{i:06d}.png: does not exist" for i in range(900)]))
    assert text.count(".png") == SHOWN
    assert text.endswith(f"and {900 - SHOWN} more")
    assert "900 of 900 frames" in text


def test_the_log_of_frames_that_were_not_drawn_is_named(tmp_path: Path) -> None:
    lost = _capture([None, "000001.png: does not exist"])
    log = tmp_path / "captures" / lost.id / "log.txt"
    log.parent.mkdir(parents=True)
    log.write_text("ValueError")
    results = replace(results_example(), captures=[lost])
    assert f"log: {log}" in outcome_lines(tmp_path, results)


def test_sound_captures_say_nothing(tmp_path: Path) -> None:
    assert outcome_lines(tmp_path, results_example()) == []


def test_seconds_by_the_methods_clock_stand_next_to_ours(tmp_path: Path) -> None:
    results = results_example()
    captures = [
        replace(one, isolation="namespaces", fit_seconds=0.001, wall_seconds=8.3)
        for one in results.captures
    ]
    lines = outcome_lines(tmp_path, replace(results, captures=captures))
    said, ran = 0.001 * len(captures), 8.3 * len(captures)
    expected = f"times: {said:.1f} s of fitting, by the method's clock; processes ran {ran:.1f} s"
    assert expected in lines


def test_fits_that_end_within_half_of_their_seconds_are_named(tmp_path: Path) -> None:
    results = results_example()
    first, *others = results.captures
    captures = [replace(first, steps=50, fit_seconds=3.2)]
    captures += [replace(one, steps=900, fit_seconds=63.9) for one in others]

    def warnings(seconds: float | None, steps: int | None) -> list[str]:
        budget = {"seconds": seconds, "steps": steps}
        lines = outcome_lines(tmp_path, replace(results, captures=captures, budget=budget))
        return [line for line in lines if line.startswith("warning")]

    expected = f"1 of {len(captures)} fits ended early in 64 s: {first.id} (50 steps, 3.2 s)"
    assert warnings(64.0, 100_000) == [f"warning: {expected}; see log.txt in their folders"]
    assert warnings(64.0, None) == warnings(64.0, 100_000)
    # It took all its steps, has enough seconds, or no limit of them.
    assert warnings(64.0, 50) == warnings(6.0, None) == warnings(None, None) == []


def test_timed_fits_that_shared_a_core_are_named(tmp_path: Path) -> None:
    results = results_example()
    alone = {"fit_seconds": 64.0, "cpu_seconds": 62.0, "device": "cpu", "steps": 900}
    first, *others = (replace(one, **alone) for one in results.captures)

    def warnings(seconds: float | None, **changes: object) -> list[str]:
        captures, budget = [replace(first, **changes), *others], {"seconds": seconds, "steps": None}
        lines = outcome_lines(tmp_path, replace(results, captures=captures, budget=budget))
        return [line for line in lines if line.startswith("warning")]

    count = len(results.captures)
    named = f"1 of {count} fits had less than 90 % of a core: {first.id} (50 %)"
    told = f"warning: {named}; run timed fits on an idle machine"
    assert warnings(64.0, cpu_seconds=32.0) == [told]
    # Alone, on a GPU, with a clock that nobody read, or with steps for a limit.
    assert warnings(64.0) == warnings(64.0, cpu_seconds=5.0, device="cuda") == []
    assert warnings(64.0, cpu_seconds=None) == warnings(None, cpu_seconds=32.0) == []
