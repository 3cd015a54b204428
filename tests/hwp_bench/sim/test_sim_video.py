"""H.264 over a clip. Oracles: the same stream again, the bits that were asked for, a codec's loss.

The loss must fall with more bits, and the clean version must be a stream of its own.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.base.errors import HwpError
from hwp_bench.capture import open_capture
from hwp_bench.sim.effects import plan_frame
from hwp_bench.sim.produce import capture as production
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.produce.forecast import forecast
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.sensor import Sensor, through_h264

SceneMaker = Callable[..., Scene]
FRAMES, SIZE = 12, 48


def _clip(height: int, width: int) -> list[np.ndarray]:
    """A textured square that moves over a smooth ground."""
    rng = np.random.default_rng(3)
    texture = rng.integers(40, 220, (16, 16, 3), dtype=np.uint8)
    ramp = np.linspace(60, 180, width)[None, :, None] * np.ones((height, 1, 3))
    frames = []
    for step in range(FRAMES):
        frame = ramp.astype(np.uint8)
        frame[8:24, 4 + step : 20 + step] = texture
        frames.append(frame)
    return frames


@pytest.mark.parametrize(("height", "width"), [(48, 48), (47, 33)])
def test_a_clip_keeps_its_frames_and_loses_less_with_more_bits(height: int, width: int) -> None:
    frames = _clip(height, width)
    losses = []
    for bits in (0.05, 0.3, 2.0):
        stored = list(through_h264(iter(frames), bits, 30.0, "clip"))
        assert [image.shape for image in stored] == [(height, width, 3)] * FRAMES
        again = list(through_h264(iter(frames), bits, 30.0, "clip"))
        np.testing.assert_array_equal(stored, again)
        # With enough bits every frame is nearest to its own: none is late or lost.
        grey = np.array(frames, dtype=float).mean(axis=3)
        for number, image in enumerate(stored):
            distances = np.square(grey - image.astype(float).mean(axis=2)).mean(axis=(1, 2))
            assert bits < 2.0 or int(distances.argmin()) == number
        losses.append(float(np.square(np.array(stored, dtype=float) - frames).mean()))
    assert losses[0] > losses[1] > losses[2]


def test_frames_are_predicted_from_those_before() -> None:
    # Oracle: a codec without prediction over time stores a frame alike, whatever came before.
    frames = _clip(48, 48)
    other = [frames[0][::-1].copy(), *frames[1:]]
    one, two = (list(through_h264(iter(clip), 0.3, 30.0, "clip")) for clip in (frames, other))
    assert (one[3] != two[3]).any()


def test_a_capture_is_one_stream_however_often_it_was_interrupted(
    make_scene: SceneMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = replace(make_scene(), sensor=Sensor(noise=0.01, h264=0.4))
    assert plan_frame(scene, 0, FRAMES, SIZE).passes[-1] == "h264"
    whole = render_capture(
        scene, tmp_path / "a", frame_count=FRAMES, size=SIZE, workers=1, free_view=False
    )
    honest, done = production.render_waiting, []

    def broken(*args: object, **settings: object) -> None:
        if len(done) == 5:
            raise KeyboardInterrupt
        done.append(1)
        honest(*args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(production, "render_waiting", broken)
    with pytest.raises(KeyboardInterrupt):
        render_capture(
            scene, tmp_path / "b", frame_count=FRAMES, size=SIZE, workers=1, free_view=False
        )
    monkeypatch.setattr(production, "render_waiting", honest)
    late = render_capture(
        scene, tmp_path / "b", frame_count=FRAMES, size=SIZE, workers=1, free_view=False
    )
    assert whole.info.digests == late.info.digests
    bare = replace(scene, sensor=Sensor(noise=0.01))
    plain = render_capture(
        bare, tmp_path / "c", frame_count=FRAMES, size=SIZE, workers=1, free_view=False
    )
    for frame in range(FRAMES):
        change = whole.frame(frame).astype(float) - plain.frame(frame)
        assert 0.3 < np.abs(change).mean() < 12.0
        assert np.abs(whole.clean(frame).astype(float) - plain.clean(frame)).mean() < 12.0
    # Each is its own stream: the perturbed frames before it changed what this frame is made of.
    last = FRAMES - 1
    np.testing.assert_array_equal(plain.frame(last), plain.clean(last))
    assert (whole.frame(last) != whole.clean(last)).any()
    assert open_capture(tmp_path / "a").info.source["renderer"] == production.RENDERER


def test_the_plan_names_the_video_and_its_cost(make_scene: SceneMaker) -> None:
    scene = make_scene()
    video = replace(scene, sensor=Sensor(noise=0.01, h264=0.2))
    found = forecast(video, 10, SIZE)
    assert found.passes["h264"] == 10
    assert "h264" not in forecast(scene, 10, SIZE, probe=False).passes
    assert found.seconds is not None


def test_without_an_encoder_the_scene_is_refused(
    make_scene: SceneMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    scene = replace(make_scene(), sensor=Sensor(noise=0.01, h264=0.2))
    with pytest.raises(HwpError, match="nothing here can encode") as caught:
        render_capture(scene, tmp_path / "x", frame_count=10, size=32)
    assert "pip install av" in str(caught.value)
    assert caught.value.field == "sensor.h264"
    assert not (tmp_path / "x").exists()
