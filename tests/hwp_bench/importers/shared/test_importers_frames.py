"""Crop windows. Oracle: projection into the whole frame, then shift and scale by hand."""

from __future__ import annotations

import os
import threading
from collections.abc import Generator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_clip import FOCAL, HEIGHT, WIDTH, make_clip

from hwp_bench.importers.shared.frames import (
    MOST_THREADS,
    CropWindows,
    ahead,
    cut,
    each_frame,
    follow_hands,
    resample,
)
from hwp_bench.importers.shared.landmarks import Landmarks


def test_the_cropped_camera_sees_what_the_crop_shows() -> None:
    clip = make_clip(8)
    windows = follow_hands([clip.landmarks], 30.0, 100)
    Ks = windows.intrinsics(np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]))
    for frame in range(8):
        rays = clip.joints[frame] / clip.joints[frame, :, 2:]
        pixels = (rays @ Ks[frame].T)[:, :2]
        moved = (clip.landmarks.image[frame] - windows.corners[frame]) * 100 / windows.side
        np.testing.assert_allclose(pixels, moved, atol=1e-9)


def test_a_pixel_keeps_its_place() -> None:
    # A white 4x4 block at (40..44, 20..24) of the frame: its centre is (42, 22).
    picture = np.zeros((60, 80, 3), dtype=np.uint8)
    picture[20:24, 40:44] = 255
    windows = CropWindows(np.array([[30, 10]]), 40, 20)
    crop = resample(cut(picture, windows.corners[0], 40), 20)[..., 0].astype(float)
    rows, columns = np.mgrid[:20, :20] + 0.5
    centre = np.array([(crop * columns).sum(), (crop * rows).sum()]) / crop.sum()
    np.testing.assert_allclose(centre, (np.array([42, 22]) - [30, 10]) / 2, atol=1e-9)


@given(corner=st.tuples(st.integers(-100, 100), st.integers(-100, 100)), side=st.integers(1, 90))
def test_cut_equals_padding_and_slicing(corner: tuple[int, int], side: int) -> None:
    picture = np.random.default_rng(0).integers(1, 255, (40, 50)).astype(np.uint8)
    x, y = corner
    padded = np.pad(picture, 200)[200 + y : 200 + y + side, 200 + x : 200 + x + side]
    np.testing.assert_array_equal(cut(picture, np.array(corner), side), padded)


@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_windows_hold_every_landmark_of_every_detected_frame(seed: int, frames: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.uniform(-50, 400, (frames, 1, 2)) + rng.uniform(0, 80, (frames, 21, 2))
    detected = rng.random(frames) < 0.7
    detected[rng.integers(frames)] = True
    image[~detected] = 0.0
    landmarks = Landmarks(image, np.zeros((frames, 21, 3)), np.ones(frames), detected)
    windows = follow_hands([landmarks], 30.0, 256)
    inside = (image - windows.corners[:, None])[detected]
    assert inside.min() >= 0
    assert inside.max() <= windows.side


def test_the_window_does_not_tremble() -> None:
    # Landmark noise of 3 px (standard deviation) moves the window by less than a pixel a frame.
    rng = np.random.default_rng(1)
    image = np.random.default_rng(2).uniform(100, 200, (1, 21, 2)) + rng.normal(0, 3, (90, 1, 2))
    landmarks = Landmarks(image, np.zeros((90, 21, 3)), np.ones(90), np.ones(90, dtype=bool))
    steps = np.diff(follow_hands([landmarks], 30.0, 256).corners, axis=0)
    assert np.abs(steps).max() <= 1


@pytest.mark.parametrize("cores", [1, 2, 64])
def test_results_come_in_order(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    later = threading.Event()

    def work(frame: int) -> int:
        if frame == 0 and cores > 1:
            assert later.wait(300.0)  # the first result is ready after the second
        later.set()
        return frame * frame

    assert list(each_frame(work, range(50))) == [frame * frame for frame in range(50)]


def test_few_results_are_held_and_an_error_ends_the_work() -> None:
    begun = []

    def work(frame: int) -> int:
        begun.append(frame)
        if frame == 3:
            raise ValueError("frame 3")
        return frame

    found = each_frame(work, range(1000))
    assert next(found) == 0
    with pytest.raises(ValueError, match="frame 3"):
        list(found)
    assert len(begun) < 20 * MOST_THREADS


def test_the_next_frame_is_computed_meanwhile_in_one_thread() -> None:
    threads, reached = set(), threading.Event()

    def frames() -> Generator[int]:
        try:
            for frame in range(5):
                if frame == 1:
                    reached.set()
                threads.add(threading.get_ident())
                yield frame
        finally:
            threads.add(threading.get_ident())

    found = ahead(frames())
    assert next(found) == 0
    assert reached.wait(300.0)  # nobody has asked for frame 1
    assert list(found) == [1, 2, 3, 4]
    assert threads != {threading.get_ident()}
    assert len(threads) == 1


def test_an_error_ahead_comes_in_its_place_and_a_reader_may_leave() -> None:
    ended = threading.Event()

    def frames() -> Generator[int]:
        try:
            yield 0
            yield 1
            raise ValueError("frame 2")
        finally:
            ended.set()

    found = ahead(frames())
    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(ValueError, match="frame 2"):
        next(found)
    ended.clear()
    for frame in ahead(frames()):
        assert frame == 0
        break
    assert ended.wait(300.0)
