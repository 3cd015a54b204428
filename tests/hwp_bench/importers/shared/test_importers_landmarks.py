"""Landmark files. Oracle: the arrays that were written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from synthetic_clip import write_landmarks

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.importers.shared.landmarks import Landmarks, check_against_video, read_landmarks


def example(frames: int = 5) -> Landmarks:
    rng = np.random.default_rng(0)
    image = rng.uniform(50, 250, (frames, 21, 2))
    world = rng.uniform(-0.08, 0.08, (frames, 21, 3))
    return Landmarks(image, world, np.full(frames, 0.9), np.ones(frames, dtype=bool))


def test_what_was_written_is_read(tmp_path: Path) -> None:
    truth = example()
    # A third coordinate of the image is dropped.
    deep = np.concatenate([truth.image, np.ones((5, 21, 1))], axis=2)
    path = write_landmarks(tmp_path / "a.npz", truth, image=deep)
    read = read_landmarks(path, min_score=0.5)
    np.testing.assert_array_equal(read.image, truth.image)
    np.testing.assert_array_equal(read.world, truth.world)
    assert read.detected.all()


def test_frames_without_a_hand_may_be_nan(tmp_path: Path) -> None:
    truth = example()
    image, score = truth.image.copy(), truth.score.copy()
    image[2], score[2] = np.nan, 0.0
    path = write_landmarks(tmp_path / "a.npz", truth, image=image, score=score)
    read = read_landmarks(path, min_score=0.0)
    np.testing.assert_array_equal(read.detected, [True, True, False, True, True])
    assert np.isfinite(read.image).all()


BROKEN = {
    "score": [("score", lambda a: a[:, None]), ("score", lambda a: a + 1), ("score", lambda a: -a)],
    "image": [
        ("image", lambda a: a[:, :20]),
        ("image", lambda a: a[:3]),
        ("image", lambda a: np.where(np.arange(len(a))[:, None, None] == 3, np.nan, a)),
        ("image", lambda a: a.astype(str)),
    ],
    "world": [
        ("world", lambda a: a[..., :2]),
        ("world", lambda a: a * np.inf),
        ("world", lambda a: a * 1000),
        ("world", lambda a: a * 0),
    ],
}


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("field", BROKEN)
def test_each_broken_array_is_named(tmp_path: Path, field: str) -> None:
    truth = example()
    for name, damage in BROKEN[field]:
        path = write_landmarks(tmp_path / "a.npz", truth, **{name: damage(getattr(truth, name))})
        with pytest.raises(BadInput) as caught:
            read_landmarks(path, min_score=0.5)
        assert caught.value.field == field
        assert caught.value.where == str(path)
    truth.image[3, 7, 1] = np.nan
    broken = write_landmarks(tmp_path / "b.npz", truth)
    with pytest.raises(BadInput, match="first in frame 3"):
        read_landmarks(broken, min_score=0.5)


def test_missing_files_and_arrays_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="does not exist"):
        read_landmarks(tmp_path / "none.npz", min_score=0.5)
    np.savez(tmp_path / "a.npz", image=example().image)
    with pytest.raises(BadInput, match="world, score"):
        read_landmarks(tmp_path / "a.npz", min_score=0.5)


def test_scores_below_the_limit_are_no_detection(tmp_path: Path) -> None:
    truth = example()
    score = np.array([0.9, 0.2, 0.9, 0.9, 0.1])
    path = write_landmarks(tmp_path / "a.npz", truth, score=score)
    assert read_landmarks(path, min_score=0.5).detected.sum() == 3
    with pytest.raises(BadInput, match="no frame has a score"):
        read_landmarks(path, min_score=0.95)


def test_another_video_is_noticed() -> None:
    with pytest.raises(BadInput, match="has 5 frames, the video has 6"):
        check_against_video(example(), 6, 320, 240, "a.npz")
    normalised = Landmarks(
        example().image / 320, example().world, example().score, example().detected
    )
    with pytest.raises(BadInput, match="not in \\[0, 1\\]"):
        check_against_video(normalised, 5, 320, 240, "a.npz")


def test_strays_are_no_detection() -> None:
    landmarks = example()
    landmarks.image[1] += 1000
    landmarks.image[2, 0] = 1e9
    landmarks.image[3] = 100.0
    checked = check_against_video(landmarks, 5, 320, 240, "a.npz")
    np.testing.assert_array_equal(checked.detected, [True, False, False, False, True])


@given(
    hnp.arrays(np.float64, hnp.array_shapes(min_dims=1, max_dims=3, max_side=22)),
    st.sampled_from(["image", "world", "score"]),
)
def test_any_array_is_read_or_named(
    tmp_path_factory: pytest.TempPathFactory, array: np.ndarray, name: str
) -> None:
    path = tmp_path_factory.mktemp("any") / "a.npz"
    write_landmarks(path, example(), **{name: array})
    try:
        read = read_landmarks(path, min_score=0.5)
    except HwpError:
        return
    assert np.isfinite(read.image).all()
    assert np.isfinite(read.world).all()
