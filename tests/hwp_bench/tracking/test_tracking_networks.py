"""MediaPipe's networks. Oracle: landmarks that MediaPipe itself found in a real video.

Needs the networks in the cache (`hwp-bench data track --fetch` puts them there; `.ci/run` tries to)
and, for the comparison, the real video in `../shared/data`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.base.errors import BadInput, MissingDependency
from hwp_bench.importers.video.decode import FrameRange, probe, read_frames
from hwp_bench.tracking.networks import (
    HAND,
    PALM,
    HandModels,
    LiteRtNetworks,
    load_models,
    models_folder,
)
from hwp_bench.tracking.track_video import track_frames
from hwp_bench.tracking.tracker import TrackerSettings

CLIP = Path(__file__).resolve().parents[4] / "shared" / "data" / "real_hand"


@pytest.fixture(scope="module")
def networks() -> LiteRtNetworks:
    if not all((models_folder() / name).is_file() for name in (PALM, HAND)):
        pytest.skip("the networks are not in the cache: hwp-bench data track --fetch")
    return LiteRtNetworks(load_models())


def test_an_empty_picture_shows_no_hand(networks: LiteRtNetworks) -> None:
    grey = np.full((96, 128, 3), 128, np.uint8)
    assert track_frames([grey, grey], networks, TrackerSettings()).hands((128, 96), 2) is None


def test_landmarks_are_those_of_mediapipe(networks: LiteRtNetworks) -> None:
    video = CLIP / "human_hand_video.mp4"
    if not video.is_file():
        pytest.skip("the real video is not here")
    count = 8
    frames = (frame for _, frame in read_frames(probe(video), FrameRange(stop=count)))
    hands = track_frames(frames, networks, TrackerSettings()).hands((1280, 720), 2)
    assert hands is not None
    with np.load(CLIP / "landmarks.npz") as expected:
        apart = hands.image[0, :, :, :2] - expected["image"][:count, :, :2]
        assert np.median(np.linalg.norm(apart, axis=2)) < 1.0
        depth = hands.image[0, :, :, 2] - expected["image"][:count, :, 2]
        assert np.median(np.abs(depth)) < 1.0
        apart = hands.world[0] - expected["world"][:count]
        assert np.median(np.linalg.norm(apart, axis=2)) < 1e-3
        # The tool wrote how sure the network is of the side, which was right in every frame.
        np.testing.assert_allclose(hands.right[0], expected["score"][:count], atol=0.01)
    assert hands.side(0) == "right"


def test_other_networks_are_refused(networks: LiteRtNetworks) -> None:
    models = load_models()
    with pytest.raises(BadInput, match="Only MediaPipe's networks"):
        LiteRtNetworks(HandModels(models.hand, models.palm, "swapped"))
    with pytest.raises(BadInput, match="cannot be loaded"):
        LiteRtNetworks(HandModels(models.palm[:5000], models.hand, "truncated"))


def test_without_the_runtime_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(MissingDependency, match=r"pip install 'hwp-bench\[track\]'"):
        LiteRtNetworks(HandModels(b"", b"", "nothing"))
