"""Diagnostics of a method are kept by name and within bounds. Oracle: the files that it wrote.

Methods side by side. Oracle: the truth submitted as an entry draws the truth's own tile.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker, results_example

from hwp_bench.base.drawing import GAP, LABEL_HEIGHT
from hwp_bench.base.images import read_rgb, write_image
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.evaluation import artifacts
from hwp_bench.evaluation.artifacts import write_side_by_side
from hwp_bench.evaluation.scoring import read_prediction
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import FrameResult


def test_named_files_are_kept_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    (source / "weights").mkdir(parents=True)
    (source / "right-temporal.json").write_text("{}")
    (source / "weights" / "000001.png").write_bytes(b"12345")
    (source / "weights" / "000002.png").write_bytes(b"12345")
    (source / "program.sh").write_text("echo")
    secret = tmp_path / "secret"
    secret.write_text("secret")
    (source / "left-temporal.json").symlink_to(secret)
    monkeypatch.setattr(artifacts, "MAX_DIAGNOSTICS", 7)
    artifacts.keep_diagnostics(source, target)
    kept = sorted(str(path.relative_to(target)) for path in target.rglob("*") if path.is_file())
    assert kept == ["right-temporal.json", "weights/000001.png"]
    artifacts.keep_diagnostics(tmp_path / "absent", target)
    assert not target.exists()


def test_files_of_holes_are_not_copied_whole(tmp_path: Path) -> None:
    """Three gigabytes that take no room in the output take none in the results either."""
    source, kept = tmp_path / "source", tmp_path / "kept"
    source.mkdir()
    (source / "000001.png").write_bytes(b"12345")
    for name in ("000002.png", "log.txt"):
        (source / name).touch()
        os.truncate(source / name, 3 << 30)
    artifacts.keep_predictions(kept, source, [1, 2, 3])
    artifacts.keep_log(source / "log.txt", kept / "log.txt")
    facts = {path.name: path.stat() for path in kept.iterdir()}
    assert sorted(facts) == ["000001.png", "000002.png", "log.txt"]
    assert (kept / "000001.png").read_bytes() == b"12345"
    assert facts["log.txt"].st_size < 2 << 20
    assert sum(one.st_blocks for one in facts.values()) * 512 < 2 << 20
    # It fails as the file itself did, so that a verification agrees.
    before, after = (read_prediction(folder, 2, (8, 8)).failure for folder in (source, kept))
    assert before == after == "000002.png: is larger than any image may be"


def test_extreme_frames_are_those_of_the_scores() -> None:
    scores = enumerate((30.0, 10.0, 20.0, 25.0))
    rows = [FrameResult(frame, {"psnr": psnr}, None) for frame, psnr in scores]
    assert artifacts.find_extreme_frames(rows) == {"worst": 1, "median": 3, "best": 0}


#: Test frames and their scores: the middle one is drawn.
SCORES = {16: 30.0, 17: 10.0, 18: 20.0}


def source(folder: Path, capture: Capture, *, predicted: bool) -> ResultsSource:
    """An entry whose prediction of the middle frame is the truth, or that has none."""
    example = results_example("truth" if predicted else "silent")
    frames = [FrameResult(frame, {"psnr": psnr}, None) for frame, psnr in SCORES.items()]
    captures = [replace(example.captures[0], id=capture.info.id, frames=frames)]
    if predicted:
        place = folder / "captures" / capture.info.id / "predictions"
        place.mkdir(parents=True)
        for frame in SCORES:
            pixels = capture.frame(frame)
            write_image(place / frame_name(frame), pixels if frame == 18 else 0 * pixels)
    return ResultsSource(replace(example, captures=captures), folder)


def tiles(path: Path, count: int) -> list[np.ndarray]:
    """The tiles of a picture of one row, without their labels."""
    page = read_rgb(path)
    width = (page.shape[1] - GAP) // count
    return [
        page[GAP + LABEL_HEIGHT : -GAP, GAP + index * width : (index + 1) * width]
        for index in range(count)
    ]


def test_the_truth_as_an_entry_looks_like_the_truth(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture(frames=20, size=48)
    sources = [
        source(tmp_path / "truth", capture, predicted=True),
        source(tmp_path / "silent", capture, predicted=False),
    ]
    path = write_side_by_side(tmp_path / "picture.png", sources, [capture])
    truth, same, silent = tiles(path, 3)
    assert truth.any()
    np.testing.assert_array_equal(truth, same)
    assert not silent.any()
    # One frame alone is its own median.
    entry = sources[0].results
    found = replace(entry.captures[0], frames=entry.captures[0].frames[:1])
    alone = ResultsSource(replace(entry, captures=[found]), sources[0].folder)
    assert tiles(write_side_by_side(tmp_path / "one.png", [alone], [capture]), 2)[0].any()
