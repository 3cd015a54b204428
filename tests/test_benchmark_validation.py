"""Tuning by validation frames. Oracles: a score by hand, and the settings of the baselines."""

from __future__ import annotations

import os
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from painted import QUICK, SilentReport

from benchmarks import validation
from benchmarks.validation import kept_score, read_log, read_trials, score_fit, tried_settings
from hwp_bench.base.errors import BadInput
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.methods import find_method, read_manifest
from hwp_bench.methods.contract import Budget, TrainingCapture
from hwp_bench.methods.manifest import shipped_methods
from hwp_bench.metrics.score import score_frame
from hwp_bench.run.worker import load_entry
from plain_fit.method import PlainMethod


@pytest.mark.parametrize("test", [False, True])
def test_the_score_is_the_mean_over_frames_that_no_step_saw(
    make_painted: Callable[..., Capture], make_training: Callable[..., TrainingCapture], test: bool
) -> None:
    capture, training = make_painted(), make_training()
    split = contiguous_split(capture.info.id, capture.info.frame_count)
    found = score_fit("plain", capture.root, QUICK, Budget(steps=3), 0, test=test)
    avatar = PlainMethod(QUICK, 0).fit(training, Budget(steps=3), SilentReport())
    scores = []
    for frame in (split.test if test else split.validation).tolist():
        drawn = avatar.render(training.hand_poses(frame), training.camera(frame))[..., :3]
        mask, exact = capture.scoring_mask(frame)
        pixels = np.round(255.0 * drawn).astype(np.uint8)
        scores.append(score_frame(pixels, capture.frame(frame), mask, coverage=exact)["psnr"])
    assert found == pytest.approx(np.mean(scores), abs=1e-3)


def test_every_baseline_that_ships_has_trials() -> None:
    names = {method.name for method in shipped_methods()} - {"wildghand"}
    assert read_trials().keys() == names


@pytest.mark.parametrize("name", read_trials())
def test_each_baseline_has_as_many_trials_and_all_can_be_run(name: str) -> None:
    listed: Any = read_trials()[name]
    assert len(listed["captures"]) == 2
    assert len(set(listed["trials"])) == 6
    manifest = read_manifest(find_method(name))
    make: Any = load_entry(manifest.root, str(manifest.entry.python))
    preset = manifest.presets["mini"]
    made = []
    for text in ["", *listed["trials"]]:
        settings = make(tried_settings(preset, listed, text), 0).settings
        assert settings not in made
        made.append(settings)
    # Its preset is what it had then, or the trial that took its place.
    assert (make(preset, 0).settings == made[0]) == ("before" not in listed)


def test_a_fit_is_made_once_and_found_in_the_log(tmp_path: Path) -> None:
    log, made = tmp_path / "log.jsonl", []

    def make() -> float:
        made.append(len(made))
        return 20.0 + len(made)

    first = {"method": "plain", "trial": "", "capture": "a", "seed": 0}
    assert kept_score(log, first, make) == 21.0
    assert kept_score(log, {**first, "capture": "b"}, make) == 22.0
    assert kept_score(log, first, make) == 21.0
    assert len(made) == 2
    assert [line["score"] for line in read_log(log)] == [21.0, 22.0]
    log.write_text(log.read_text() + '{"method":')
    with pytest.raises(BadInput, match=r"log.jsonl.*not JSON"):
        read_log(log)


def test_a_row_of_ones_own_is_neither_read_from_the_log_nor_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The trials of plain start from a preset of before; a row of one's own does not.
    log, rates = tmp_path / "log.jsonl", []

    def score(method: str, path: Path, settings: Any, *rest: Any, test: bool = False) -> float:
        rates.append(settings["color_rate"])
        return 20.0

    monkeypatch.setattr(validation, "score_fit", score)
    monkeypatch.setattr(validation, "ensure_suite", lambda items, **_: [tmp_path] * len(items))
    capture = SimpleNamespace(info=SimpleNamespace(id="wild-dev-0"), digest="d")
    monkeypatch.setattr(validation, "open_capture", lambda path: capture)
    given = {
        "suite": "wild-dev", "captures": ["wild-dev-0"], "preset": "mini", "steps": 3,
        "seconds": None, "test": False, "seed": 0, "log": log,
    }  # fmt: skip
    validation.print_table("plain", Namespace(set=None, **given))
    before, kept = rates[0], log.read_bytes()
    validation.print_table("plain", Namespace(set=["opacity_rate=0.02"], **given))
    today = read_manifest(find_method("plain")).presets["mini"]["color_rate"]
    assert rates[-2:] == [today, today]
    assert before != today
    assert log.read_bytes() == kept


def test_processor_seconds_are_those_of_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    def look(*given: Any) -> None:
        seen.append((os.environ.get("OMP_NUM_THREADS"), torch.get_num_threads()))

    monkeypatch.setattr(validation, "print_table", look)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(sys, "argv", ["validation", "plain", "--seconds", "1"])
    before = torch.get_num_threads()
    try:
        validation.main()
    finally:
        torch.set_num_threads(before)
    assert seen == [("1", 1)]
