"""The benchmark of two hands. Oracle: the landmarks of the real clip, and their mirror image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.two_hands import VOTES, compose
from hwp_bench.importers.shared.landmarks import read_association, read_landmarks
from hwp_bench.importers.video.decode import probe

REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "real_hand"


@pytest.mark.slow
def test_hands_of_the_composed_clip_are_told_apart(tmp_path: Path) -> None:
    if not REAL.is_dir():
        pytest.skip("the real video is not here")
    video, landmarks = REAL / "human_hand_video.mp4", REAL / "landmarks.npz"
    composed = compose(video, landmarks, tmp_path, frames=16, stride=6)
    assert probe(composed.video).stated_frames == 16
    found = read_association(composed.landmarks)
    assert found is not None
    assert found.swaps == composed.swaps == 3
    for side, true in zip(("right", "left"), composed.true, strict=True):
        read = read_landmarks(composed.landmarks, min_score=0.5, side=side)
        assert read.detected.all()
        np.testing.assert_allclose(read.image, true, atol=1e-3)
    # The landmarks of both lie among each other for a while.
    middles = composed.true.mean(axis=2)[:, :, 0]
    assert np.abs(middles[0] - middles[1]).min() < 60
    assert np.abs(middles[0] - middles[1]).max() > 300
    assert found.tracks.votes(0)["right"] == pytest.approx(VOTES[0], abs=1e-6)
