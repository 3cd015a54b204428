"""Fixtures for every test."""

from __future__ import annotations

# isort: off
from worker_threads import (
    WORKER,
    WORKER_NUMBER,
)  # first: it says how many threads NumPy and torch use

# isort: on
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from small_captures import (
    CaptureMaker,
    cameras,
    free_hand,
    hand_parameters,
    hand_picture,
    results_example,
)

from hwp_bench.capture import Capture, CaptureInfo, CaptureWriter, open_capture
from hwp_bench.results import Results

#: Skips that nobody allowed fail; and projects for the test of that.
pytest_plugins = ["skips", "pytester"]

# How long an example takes says something about the machine and its load, not about the code.
settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run files with slow tests first: no worker waits at the end for another's long file."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session")
def machine_code(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Everything is compiled that tests need, each part by the first worker that asks for it.

    Every second worker begins with the last part, so that two share the work.
    """
    from own_cache import COMPILED

    from hwp_bench.base.folders import exclusive

    # All workers' temporary folders lie in one.
    shared = tmp_path_factory.getbasetemp().parent if WORKER else tmp_path_factory.getbasetemp()
    parts = list(COMPILED)
    for part in parts[::-1] if WORKER_NUMBER % 2 else parts:
        done = shared / f"compiled-{part}"
        with exclusive(done, wait=True):
            if not done.exists():
                COMPILED[part]()
                done.touch()


@pytest.fixture
def make_capture(tmp_path: Path) -> CaptureMaker:
    """Return a function that writes a capture and opens it."""

    def make(
        name: str = "tiny",
        *,
        frames: int = 20,
        size: int = 32,
        hands: str = "right",
        perturbations: dict[str, tuple[int, ...] | None] | None = None,
        truth: bool = False,
        folder: Path | None = None,
    ) -> Capture:
        if perturbations is None:
            perturbations = {"motion_blur": tuple(3 if f % 4 == 1 else 0 for f in range(frames))}
            last = frames - frames * 9 // 10
            severities = perturbations["motion_blur"][: frames - last] + (0,) * last
            perturbations = {"motion_blur": severities}
        info = CaptureInfo(
            id=name,
            hands=hands,
            action="Waving",
            device="Test",
            fps=30.0,
            width=size,
            height=size,
            frame_count=frames,
            hand_model=free_hand(hands),
            perturbations=perturbations,
            source={"kind": "test"},
            licence="CC0",
        )
        parameters = {side: hand_parameters(frames, i) for i, side in enumerate(info.sides)}
        path = (folder or tmp_path) / name
        with CaptureWriter(path, info, parameters, cameras(frames, size)) as writer:
            for frame in range(frames):
                picture, mask = hand_picture(frame, size)
                writer.frame(frame, picture)
                writer.mask(frame, mask)
                if truth:
                    writer.clean(frame, picture)
                    writer.true_mask(frame, mask)
                    writer.clean_mask(frame, mask)
            if truth:
                writer.true_hands(parameters)
        return open_capture(path)

    return make


@pytest.fixture
def make_results() -> Callable[..., Results]:
    """Return a function that makes results without an evaluation."""
    return results_example


@pytest.fixture(scope="session")
def make_painted(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Capture]:
    """Return a function that draws the painted capture of `right`, `left` or `both` hands."""
    from painted import paint_capture

    made: dict[str, Capture] = {}

    def make(hands: str = "right") -> Capture:
        if hands not in made:
            made[hands] = paint_capture(tmp_path_factory.mktemp("painted") / hands, hands)
        return made[hands]

    return make


@pytest.fixture
def make_training(make_painted: Callable[..., Capture], tmp_path: Path) -> Callable[..., Any]:
    """Return a function that opens what a method is given of a painted capture."""
    from painted import FRAMES, QUICK

    from hwp_bench.capture.splits import contiguous_split
    from hwp_bench.methods.contract import Budget, RunSettings
    from hwp_bench.methods.request import open_request, write_request

    def make(hands: str = "right", **settings: object) -> Any:
        capture = make_painted(hands)
        split = contiguous_split(capture.info.id, FRAMES)
        run = RunSettings({**QUICK, **settings}, 0, Budget())
        return open_request(write_request(tmp_path / f"request-{hands}", capture, split, run))

    return make
