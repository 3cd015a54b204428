"""Which side a hand is of. Oracle: simulated hands of known sides, and a real right hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic_clip import (
    FPS,
    HEIGHT,
    WIDTH,
    landmark_import,
    make_clip,
    write_landmarks,
    write_video,
)

from hwp_bench.importers.shared.landmarks import Landmarks, read_landmarks
from hwp_bench.importers.video.api import import_video
from hwp_bench.importers.video.solve import (
    CLEAR,
    Footage,
    SideScores,
    side_scores,
    warn_of_contradiction,
)
from hwp_bench.importers.video.source import VideoImport

REAL = Path(__file__).resolve().parents[5] / "shared" / "data" / "real_hand"
FOOTAGE = Footage(WIDTH, HEIGHT, FPS, None)
FEW = landmark_import(5, outline_steps=1)


def noisy(landmarks: Landmarks) -> Landmarks:
    """Errors of 4 mm and 1.5 px, as a tracker's."""
    random = np.random.default_rng(3)
    return Landmarks(
        landmarks.image + random.normal(0, 1.5, landmarks.image.shape),
        landmarks.world + random.normal(0, 0.004, landmarks.world.shape),
        landmarks.score,
        landmarks.detected,
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_simulated_hands_of_both_sides(side: str) -> None:
    other = "left" if side == "right" else "right"
    scores = side_scores(noisy(make_clip(10, side=side).landmarks), "anny", FOOTAGE)
    assert scores.frames == 10
    assert scores.better == side
    # Noise alone leaves 4 mm in each of three directions, 7 mm; the wrong side adds bends.
    assert getattr(scores, side) < 0.008
    assert getattr(scores, other) > 1.3 * getattr(scores, side)


def test_frames_without_a_hand_do_not_count() -> None:
    clip = make_clip(8).landmarks
    seen = np.arange(8) % 2 == 0
    landmarks = Landmarks(
        np.where(seen[:, None, None], clip.image, 0.0),
        np.where(seen[:, None, None], clip.world, 0.0),
        np.where(seen, 1.0, 0.0),
        seen,
    )
    scores = side_scores(landmarks, "anny", FOOTAGE)
    assert (scores.frames, scores.better) == (4, "right")


@pytest.mark.parametrize(
    ("stated", "scores", "votes", "warned"),
    [
        ("left", (0.005, 0.010), {"right": 0.95, "left": 0.05}, True),
        ("right", (0.005, 0.010), {"right": 0.95, "left": 0.05}, False),
        # The fit is clear, the votes err.
        ("right", (0.005, 0.010), {"right": 0.4, "left": 0.6}, False),
        ("left", (0.005, 0.010), {"right": 0.4, "left": 0.6}, True),
        # The fit is not clear: the votes decide, where there are any.
        ("left", (0.010, 0.010 * CLEAR), {"right": 0.9, "left": 0.1}, True),
        ("left", (0.010, 0.010 * CLEAR), None, False),
        ("left", (0.005, 0.010), None, True),
    ],
)
def test_a_contradiction_is_a_warning_with_both_scores(
    stated: str,
    scores: tuple[float, float],
    votes: dict[str, float] | None,
    warned: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert warn_of_contradiction(stated, SideScores(*scores, 12), votes) is warned
    said = capsys.readouterr().err
    assert bool(said) is warned
    if warned:
        assert f"is said to be a {stated} one" in said
        assert f"{1e3 * scores[0]:.1f} mm as a right hand" in said
        assert f"{1e3 * scores[1]:.1f} mm as a left one (12 frames)" in said
        assert ("votes right" in said) is (votes is not None)


def test_a_video_with_the_wrong_side_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip = make_clip(4)
    write_video(tmp_path / "hand.avi", [clip.picture(frame) for frame in range(4)])
    write_landmarks(tmp_path / "hand.npz", clip.landmarks)
    for side, warned in (("left", True), ("right", False)):
        options = VideoImport(side=side, size=64, fit=FEW)
        import_video(tmp_path / "hand.avi", tmp_path / "hand.npz", tmp_path / side, options)
        assert ("is said to be a left one" in capsys.readouterr().err) is warned


def test_a_real_right_hand() -> None:
    if not REAL.is_dir():
        pytest.skip("the real video is not here")
    landmarks = read_landmarks(REAL / "landmarks.npz", min_score=0.5)
    scores = side_scores(landmarks, "anny", Footage(1280, 720, 30.0, None))
    assert scores.better == "right"
    assert scores.left > 1.5 * scores.right
