"""Arguments of the wrong type from Python. Oracle: one error that names the argument, no file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_captures import CaptureMaker

import hwp_bench
import wildghand
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.methods.contract import Budget, RunSettings

IMAGE = np.zeros((32, 32, 3), np.uint8)
MASK = np.full((32, 32), 255, np.uint8)
# What no argument of these functions is.
NO_NUMBERS: tuple[Any, ...] = (1.5, "3", True, None, [1], np.float64(2.0), 2j)
NO_PATHS: tuple[Any, ...] = (None, 3, b"x", "", "a\0b", 1.5, ["x"])
NO_IMAGES: tuple[Any, ...] = (None, [[1, 2]], "x", 3, (IMAGE,))


@pytest.fixture
def nothing_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    yield
    assert list(folder.iterdir()) == []


def refused(call: Callable[[], object], field: str) -> None:
    with pytest.raises(HwpError) as error:
        call()
    assert error.value.field == field
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("nothing_is_made")
def test_evaluate_names_the_argument(make_capture: CaptureMaker) -> None:
    root = make_capture(frames=20).root

    def run(**changes: Any) -> Callable[[], object]:
        given: dict[str, Any] = {"method": "plain", "captures": root, "steps": 1, **changes}
        return lambda: hwp_bench.evaluate(given.pop("method"), given.pop("captures"), **given)

    for value in NO_NUMBERS:
        refused(run(seed=value), "seed")
        refused(run(jobs=value), "jobs")
        if value is not None:
            refused(run(steps=value), "steps")
    for value in ("1", True, [1.0], float("nan"), float("inf"), 10**400, 1j):
        refused(run(seconds=value), "seconds")
    for value in NO_PATHS:
        refused(run(method=value), "method")
        if value is not None:
            refused(run(out=value), "out")
        if not isinstance(value, list):
            refused(run(captures=[root, value]), "captures[1]")
    refused(run(captures=None), "captures")
    refused(run(captures=3), "captures")
    refused(run(captures=[]), "captures")
    refused(run(preset=3), "preset")
    refused(run(settings=[("a", 1)]), "settings")
    for value in (3, "a:b", "true:", "true:colour"):
        refused(run(frames=value), "frames")
    refused(run(jobs=0), "jobs")
    refused(run(seed=-1), "seed")
    refused(run(out=root / "runs"), "out")


def test_whole_numbers_of_numpy_are_numbers() -> None:
    budget = Budget(seconds=np.float32(2.0), steps=np.int64(3))
    assert (type(budget.steps), type(budget.seconds)) == (int, float)
    assert type(RunSettings(seed=np.uint8(4)).seed) is int


def test_score_takes_arrays_only() -> None:
    assert hwp_bench.score(IMAGE, IMAGE, MASK)["psnr"] == 100.0
    for value in NO_IMAGES:
        refused(lambda value=value: hwp_bench.score(value, IMAGE, MASK), "prediction")
        refused(lambda value=value: hwp_bench.score(IMAGE, value, MASK), "target")
        refused(lambda value=value: hwp_bench.score(IMAGE, IMAGE, value), "mask")
    for other in (IMAGE.astype(complex), IMAGE.astype(object), IMAGE.astype("U1"), IMAGE[0]):
        with pytest.raises(HwpError):
            hwp_bench.score(other, IMAGE, MASK)


def test_a_frame_is_named_by_a_whole_number(make_capture: CaptureMaker) -> None:
    capture = make_capture(frames=20)
    np.testing.assert_array_equal(capture.frame(np.int64(3)), capture.frame(3))
    for read in (capture.frame, capture.mask, capture.hand_poses, capture.camera):
        for value in NO_NUMBERS:
            refused(lambda value=value, read=read: read(value), "frame")
        with pytest.raises(UsageError, match="there is no frame -1"):
            read(-1)


@pytest.mark.usefixtures("nothing_is_made")
def test_paths_are_paths() -> None:
    for value in NO_PATHS:
        refused(lambda value=value: hwp_bench.open_capture(value), "path")
        refused(lambda value=value: hwp_bench.read_results(value), "path")
        refused(lambda value=value: wildghand.load_avatar(value), "path")
        refused(lambda value=value: hwp_bench.compare(value), "results")
        refused(lambda value=value: hwp_bench.render_capture(value, "out"), "scene")
        refused(lambda value=value: hwp_bench.render_capture("capture0", value), "out")
        refused(lambda value=value: wildghand.fit(value), "source")


@pytest.mark.usefixtures("nothing_is_made")
def test_other_arguments_of_the_packages() -> None:
    def render(**changes: Any) -> Callable[[], object]:
        return lambda: hwp_bench.render_capture("capture0", "out", **changes)

    for value in NO_NUMBERS:
        if value is None:
            continue
        refused(render(frame_count=value), "frame_count")
        refused(render(size=value), "size")
        refused(render(seed=value), "seed")
        refused(lambda value=value: wildghand.fit("x", steps=value), "steps")
        refused(lambda value=value: wildghand.fit("x", seed=value), "seed")
        refused(lambda value=value: hwp_bench.compare("x", resamples=value), "resamples")
    refused(render(seed=-1), "seed")
    refused(lambda: wildghand.fit("x", settings=["a"]), "settings")
    refused(lambda: wildghand.fit("x", side=3), "side")
    refused(lambda: wildghand.fit("x", seconds="3"), "seconds")
    refused(lambda: hwp_bench.compare("x", metrics=3), "metrics")
    refused(lambda: hwp_bench.compare("x", metrics=[3]), "metrics")
    refused(lambda: hwp_bench.compare("x", seed=-1), "seed")
