"""The sensor: an effect of every frame, no perturbation; only what is asked of it is done.

Oracles: the scene without the setting (bit for bit), the codec's own 8 px blocks, and for the
rolling shutter the slope that a moving edge must have, way per second times seconds per row.
Of H.264: the same stream again, the bits that were asked for, and a codec's loss, which must fall
with more bits; the clean version must be a stream of its own.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flat_surface import facing_camera
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import BLUR, CLEAN, LIGHT, OBJECT, SceneMaker

from hwp_bench.base import images
from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.capture import open_capture
from hwp_bench.sim.effects import ORDER, plan_frame
from hwp_bench.sim.geometry.surface import RenderCost, Surface, Tracer
from hwp_bench.sim.light.lights import steady_light
from hwp_bench.sim.produce import capture as production
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.produce.forecast import forecast
from hwp_bench.sim.render.frame import SimulatedFrame, knots, render_frame, row_by_row
from hwp_bench.sim.render.stage import Body, Lens, render_instant
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.sensor import Sensor, through_h264
from hwp_bench.taxonomy import PERTURBATIONS

COUNT, SIZE = 40, 48
#: Digest of the small scene before the sensor had more settings than its noise.
DIGEST = "ee8a751a9f4870a6aded2d11687819084a758e7963a86bb00fed96149a2e1c4e"


@pytest.fixture
def with_sensor(make_scene: SceneMaker) -> Callable[[str], Scene]:
    """Return a function that makes the small scene with other lines in its sensor's table."""

    def make(lines: str) -> Scene:
        return make_scene(("noise = 0.01\n", ""), ("[light]", f"[sensor]\n{lines}\n[light]"))

    return make


def _same(one: SimulatedFrame, other: SimulatedFrame) -> None:
    for name in ("rgb", "clean", "coverage", "clean_coverage"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.cost.rays == other.cost.rays


def test_the_effects_are_the_perturbations() -> None:
    assert set(ORDER) == set(PERTURBATIONS)


def test_a_scene_that_asks_for_noise_alone_is_what_it_was(
    make_scene: SceneMaker, with_sensor: Callable[[str], Scene]
) -> None:
    before, after = make_scene(), with_sensor("noise = 0.01")
    assert before.digest == after.digest == DIGEST
    assert with_sensor("noise = 0.01\njpeg_quality = 90").digest != DIGEST
    _same(render_frame(before, OBJECT, COUNT, SIZE), render_frame(after, OBJECT, COUNT, SIZE))


@pytest.mark.parametrize(
    ("lines", "passes"),
    [
        ("noise = 0.0", ()),
        ("noise = 0.01", ("sensor",)),
        ("noise = 0.0\njpeg_quality = 60", ("jpeg",)),
        ("noise = 0.0\nrolling_shutter = 0.02", ("rolling",)),
        (
            "noise = 0.01\njpeg_quality = 60\nrolling_shutter = 0.02",
            ("rolling", "sensor", "jpeg"),
        ),
    ],
)
def test_every_frame_needs_what_the_sensor_asks_for_last(
    with_sensor: Callable[[str], Scene], lines: str, passes: tuple[str, ...]
) -> None:
    scene = with_sensor(lines)
    for frame, before in ((CLEAN, ()), (OBJECT, ("objects",)), (BLUR, ("shutter",))):
        item = plan_frame(scene, frame, COUNT, SIZE)
        assert item.passes == ("hands", "shadow", "sky", "backdrop", *before, *passes)
        assert set(item.severity) == set(PERTURBATIONS) & {call.kind for call in scene.effects}
    assert not plan_frame(scene, CLEAN, COUNT, SIZE).perturbed


def test_jpeg_changes_frame_and_clean_version_alike(with_sensor: Callable[[str], Scene]) -> None:
    raw = render_frame(with_sensor("noise = 0.0"), CLEAN, COUNT, SIZE)
    stored = render_frame(with_sensor("noise = 0.0\njpeg_quality = 10"), CLEAN, COUNT, SIZE)
    np.testing.assert_array_equal(stored.rgb, stored.clean)
    assert stored.cost.rays == raw.cost.rays
    # A coarse JPEG steps where its blocks of 8 px meet, more than the image itself does.
    steps = np.abs(np.diff(stored.clean.astype(float), axis=1)).mean(axis=(0, 2))
    before = np.abs(np.diff(raw.clean.astype(float), axis=1)).mean(axis=(0, 2))
    assert steps[7::8].mean() / steps.mean() > 1.2 * before[7::8].mean() / before.mean()
    lit = render_frame(with_sensor("noise = 0.0\njpeg_quality = 10"), LIGHT, COUNT, SIZE)
    plain_lit = render_frame(with_sensor("noise = 0.0"), LIGHT, COUNT, SIZE)
    for name in ("rgb", "clean"):
        change = getattr(lit, name).astype(float) - getattr(plain_lit, name)
        assert 1.0 < np.abs(change).mean() < 12.0


def _panel(width: float, height: float, parts: int) -> Surface:
    """A vertical panel half a metre away, its left edge on the camera's axis."""
    x, y = np.meshgrid(np.linspace(0.0, width, 3), np.linspace(-height, height, parts + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)], axis=1)
    corner = (np.arange(parts)[:, None] * 3 + np.arange(2)).ravel()
    a, b, c, d = corner, corner + 1, corner + 3, corner + 4
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    return facing_camera(vertices, faces)


def _moved(surface: Surface, way: np.ndarray) -> Surface:
    from hwp_bench.sim.geometry.surface import transformed

    transform = np.eye(4)
    transform[:3, 3] = way
    return transformed(surface, transform)


@settings(max_examples=40, deadline=None)
@given(
    speed=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
    readout=st.floats(0.001, 0.05),
    time=st.floats(-0.02, 0.02),
)
def test_vertices_stand_where_their_rows_see_them(
    speed: tuple[float, float], readout: float, time: float
) -> None:
    # Closed form: y = y0 + v (t + (y f / z + c) / S * r - r / 2) is linear in y. The rounds leave
    # (2 m/s * 0.05 s * f / (z S))^4 of a way of 0.1 m, below a fifth of a millimetre here.
    size, focal, depth = 64, 64.0, 0.5
    lens = Lens(np.array([[focal, 0, 32], [0, focal, 32], [0, 0, 1.0]]), np.eye(4), size, 1)
    panel = _panel(0.2, 0.2, 16)
    vx, vy = speed
    reach = readout + 0.04
    at = knots(lambda t: _moved(panel, np.array([vx * t, vy * t, 0.0])), lambda _: np.eye(4), reach)
    found = row_by_row(at, reach, time, readout, lens).vertices
    slope = vy * readout * focal / (depth * size)
    y = (panel.vertices[:, 1] + vy * time) / (1.0 - slope)
    row = focal * y / depth + size / 2
    seen = (row >= 0) & (row <= size)
    moment = time + (row / size - 0.5) * readout
    np.testing.assert_allclose(found[seen, 1], y[seen], atol=2e-4)
    np.testing.assert_allclose(
        found[seen, 0], (panel.vertices[:, 0] + vx * moment)[seen], atol=2e-4
    )


@pytest.mark.parametrize("moves", ["hand", "camera"])
def test_a_moving_edge_is_slanted(make_scene: SceneMaker, moves: str) -> None:
    # Oracle: in an image of S rows the edge leans by speed * readout, in pixels at its depth.
    size, focal, speed, readout = 64, 128.0, 1.0, 0.03
    lens = Lens(np.array([[focal, 0, 32], [0, focal, 32], [0, 0, 1.0]]), np.eye(4), size, 2)
    panel = _panel(0.3, 0.2, 32)

    def way(time: float) -> np.ndarray:
        return np.array([speed * time, 0.0, 0.0])

    def view(time: float) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, 3] = way(time)
        return matrix

    if moves == "hand":
        at = knots(lambda time: _moved(panel, way(time)), lambda _: np.eye(4), readout)
    else:
        at = knots(lambda _: panel, view, readout)
    surface = row_by_row(at, readout, 0.0, readout, lens)
    cost = RenderCost()
    body = Body(surface, Tracer(surface.vertices, surface.faces, cost.rays))
    scene = make_scene()
    image = render_instant(scene, lens, body, None, steady_light(scene.light), cost)
    edge = size - image.coverage.sum(axis=1)
    slope = np.polyfit(np.arange(size), edge, 1)[0]
    assert slope == pytest.approx(speed * readout * focal / 0.5 / size, rel=0.05)
    assert np.abs(edge - np.polyval(np.polyfit(np.arange(size), edge, 1), range(size))).max() < 0.6


@pytest.mark.parametrize("frame", [CLEAN, OBJECT, BLUR])
def test_a_fast_readout_is_no_rolling_shutter(
    with_sensor: Callable[[str], Scene], frame: int
) -> None:
    # Oracle: the limit. Read within a microsecond, all rows show the same instant.
    still = render_frame(with_sensor("noise = 0.0"), frame, COUNT, SIZE)
    fast = render_frame(with_sensor("noise = 0.0\nrolling_shutter = 1e-6"), frame, COUNT, SIZE)
    slow = render_frame(with_sensor("noise = 0.0\nrolling_shutter = 0.05"), frame, COUNT, SIZE)
    for name in ("rgb", "clean"):
        change = np.abs(getattr(fast, name).astype(int) - getattr(still, name))
        assert np.quantile(change, 0.995) <= 1
    np.testing.assert_allclose(fast.coverage, still.coverage, atol=0.26)
    assert (
        np.abs(slow.coverage - still.coverage).sum() > np.abs(fast.coverage - still.coverage).sum()
    )
    if frame == CLEAN:
        np.testing.assert_array_equal(slow.rgb, slow.clean)


def test_noise_is_said_once_and_the_sensor_in_its_own_table(make_scene: SceneMaker) -> None:
    with pytest.raises(BadInput, match="noise"):
        make_scene(("[light]", "[sensor]\nnoise = 0.01\n[light]"))
    with pytest.raises(BadInput, match="effects") as caught:
        make_scene(('kind = "illumination"', 'kind = "sensor"'))
    assert "motion_blur" in str(caught.value)
    assert make_scene().sensor == Sensor(noise=0.01)


FRAMES = 12


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


@pytest.mark.parametrize("bits", [0.1, 0.3, 2.0])
def test_every_processor_stores_the_same_bits(bits: float, monkeypatch: pytest.MonkeyPatch) -> None:
    # Oracle: x264 without SIMD.
    frames = _clip(48, 48)
    stored = list(through_h264(iter(frames), bits, 30.0, "clip"))
    monkeypatch.setattr(images, "REPEATABLE", f"{images.REPEATABLE}:asm=0")
    np.testing.assert_array_equal(stored, list(through_h264(iter(frames), bits, 30.0, "clip")))


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
