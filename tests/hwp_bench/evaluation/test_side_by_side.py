"""Methods side by side. Oracle: the truth submitted as an entry draws the truth's own tile."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker, results_example

from hwp_bench.base.drawing import GAP, LABEL_HEIGHT
from hwp_bench.base.images import read_rgb, write_image
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.evaluation.artifacts import write_side_by_side
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import FrameResult

#: Test frames and their scores: the middle one is drawn.
SCORES = {16: 30.0, 17: 10.0, 18: 20.0}


def source(folder: Path, capture: Capture, *, predicted: bool) -> ResultsSource:
    """An entry whose predictions are the truth, or that has none."""
    example = results_example("truth" if predicted else "silent")
    frames = [FrameResult(frame, {"psnr": psnr}, None) for frame, psnr in SCORES.items()]
    captures = [replace(example.captures[0], id=capture.info.id, frames=frames)]
    if predicted:
        place = folder / "captures" / capture.info.id / "predictions"
        place.mkdir(parents=True)
        for frame in SCORES:
            write_image(place / frame_name(frame), capture.frame(frame))
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
    assert truth.max() > 0
    np.testing.assert_array_equal(truth, same)
    assert not silent.any()


@pytest.mark.parametrize("scores", [{16: 30.0}, SCORES])
def test_it_is_drawn_for_any_number_of_frames(
    make_capture: CaptureMaker, tmp_path: Path, scores: dict[int, float]
) -> None:
    capture = make_capture(frames=20, size=48)
    entry = source(tmp_path / "truth", capture, predicted=True)
    found = entry.results.captures[0]
    kept = [frame for frame in found.frames if frame.frame in scores]
    results = replace(entry.results, captures=[replace(found, frames=kept)])
    path = write_side_by_side(
        tmp_path / "picture.png", [ResultsSource(results, entry.folder)], [capture]
    )
    assert tiles(path, 2)[0].any()
