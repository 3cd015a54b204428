"""Exposure and white balance that follow the image, and sharpening.

Oracles: the scene without the setting, the level that is asked for, a step seen through a first
order lag, and for the unsharp mask the mean of an image, which it keeps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import CLEAN, LIGHT, OBJECT, SceneMaker

from hwp_bench.base.colors import LUMINANCE
from hwp_bench.sim.effects import plan_frame
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.render import frame as metering
from hwp_bench.sim.render.frame import metered_gain, render_frame
from hwp_bench.sim.scene.scene import Scene, with_effects
from hwp_bench.sim.sensor import AutoControl, Sensor, sharpened

COUNT, SIZE = 40, 48
STEADY = AutoControl(wander=0.0)


@pytest.fixture
def automatic(make_scene: SceneMaker) -> Callable[[AutoControl], Scene]:
    """Return a function that makes the small scene without noise, its camera automatic."""

    def make(auto: AutoControl) -> Scene:
        return replace(make_scene(), sensor=Sensor(noise=0.0, auto=auto))

    return make


def test_later_fields_are_in_the_scene_only_where_they_say_something(
    make_scene: SceneMaker,
) -> None:
    lines = "[sensor]\nnoise = 0.01\njpeg_quality = 70\n"
    before = make_scene(("noise = 0.01\n", ""), ("[light]", lines + "[light]"))
    assert before.to_json()["sensor"] == {
        "noise": 0.01,
        "jpeg_quality": 70,
        "rolling_shutter": 0.0,
    }
    table = "sharpening = 0.5\n[sensor.auto]\nlevel = 0.3\n"
    after = make_scene(("noise = 0.01\n", ""), ("[light]", lines + table + "[light]"))
    assert after.to_json()["sensor"]["auto"]["level"] == 0.3
    assert after.digest != before.digest


def test_the_level_is_reached(automatic: Callable[[AutoControl], Scene]) -> None:
    # Oracle: the mean luminance of the metered image times the gain; hands move little in a lag.
    for level in (0.08, 0.3):
        auto = replace(STEADY, level=level, white_balance=0.0)
        gain = metered_gain(automatic(auto), auto, 1.0, RenderCost())
        fixed = automatic(auto).sensor
        scene = replace(automatic(auto), sensor=replace(fixed, auto=None))
        look = metering._Look(scene.digest, 0, scene, 1.0, RenderCost())
        mean = float(metering._seen(look) @ LUMINANCE)
        assert mean * gain[1] == pytest.approx(level, rel=0.15)
        np.testing.assert_allclose(gain, gain[1])


def test_a_step_is_followed_with_the_lag(
    automatic: Callable[[AutoControl], Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: 1 - exp(-t / lag), within the half look that the camera waits.
    scene, turn = automatic(STEADY), 6.0

    def seen(look: metering._Look) -> np.ndarray:
        return np.full(3, 0.1 if look.number * look.tick < turn else 0.4)

    monkeypatch.setattr(metering, "_seen", seen)
    before = float(np.log2(metered_gain(scene, STEADY, turn - 0.3, RenderCost())[1]))
    after = float(np.log2(metered_gain(scene, STEADY, turn + 5.0, RenderCost())[1]))
    assert before - after == pytest.approx(2.0, abs=1e-9)
    tick = STEADY.lag / metering.LOOKS_PER_LAG
    for wait in (tick, 2 * tick, 4 * tick):
        now = float(np.log2(metered_gain(scene, STEADY, turn + wait, RenderCost())[1]))
        share = (before - now) / 2.0
        early, late = (1.0 - np.exp(-max(wait + d, 0) / STEADY.lag) for d in (-tick, tick))
        assert early - 1e-9 <= share <= late


def test_a_frame_and_its_clean_version_get_the_same_gain(
    automatic: Callable[[AutoControl], Scene],
) -> None:
    scene = automatic(AutoControl(level=0.12))
    assert plan_frame(scene, CLEAN, COUNT, SIZE).passes[-1] == "auto"
    result = render_frame(scene, CLEAN, COUNT, SIZE)
    np.testing.assert_array_equal(result.rgb, result.clean)
    fixed = render_frame(replace(scene, sensor=Sensor(noise=0.0)), CLEAN, COUNT, SIZE)
    assert np.abs(result.clean.astype(float) - fixed.clean).mean() > 2.0
    # Without any effect the camera does the same: it meters the undisturbed scene.
    bare = with_effects(scene, [])
    for frame in (LIGHT, OBJECT):
        with_it, without = (render_frame(item, frame, COUNT, SIZE) for item in (scene, bare))
        np.testing.assert_array_equal(with_it.clean, without.clean)
        assert (with_it.rgb != without.rgb).any()


def test_the_camera_wanders_by_its_seed(
    automatic: Callable[[AutoControl], Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is metered has no weight here, so that nothing need be rendered for it.
    monkeypatch.setattr(metering, "_seen", lambda look: np.full(3, 0.1))
    auto = AutoControl(exposure=0.0, white_balance=0.0, wander=0.2)
    scene = automatic(auto)
    times = np.arange(0.0, 60.0, 0.5)
    gains = np.array([metered_gain(scene, auto, time, RenderCost())[1] for time in times])
    # Four sines of random phase: their standard deviation over a minute is near that asked for.
    assert np.log2(gains).std() == pytest.approx(0.2, rel=0.4)
    other = replace(scene, seed=scene.seed + 1)
    assert metered_gain(other, auto, 3.0, RenderCost())[1] != gains[6]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**20), strength=st.floats(0.1, 2.0))
def test_sharpening_steepens_and_keeps_the_mean(seed: int, strength: float) -> None:
    import cv2

    # Away from black and white hardly anything is clipped.
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(32, 32, 3)), (0, 0), 2.0)
    noise = 20.0 * noise / noise.std(axis=(0, 1))
    image = np.clip(np.round(128.0 + noise), 0, 255).astype(np.uint8)
    found = sharpened(image, strength).astype(float)
    assert abs(found.mean() - image.mean()) < 1.0
    steepness = [np.square(np.diff(pixels * 1.0, axis=0)).sum() for pixels in (image, found)]
    # A weak strength may change less than half a level anywhere, which rounds to nothing.
    assert steepness[1] > steepness[0] or (strength < 0.5 and (found == image).all())
    # Only the luma moves: all channels of a pixel by the same.
    change = found - image
    assert np.ptp(change, axis=2).max() <= 1.0


def test_sharpening_comes_before_jpeg(make_scene: SceneMaker) -> None:
    scene = make_scene()
    passes = {}
    for name, sensor in {
        "both": Sensor(noise=0.0, sharpening=1.0, jpeg_quality=60),
        "sharp": Sensor(noise=0.0, sharpening=1.0),
        "none": Sensor(noise=0.0),
    }.items():
        passes[name] = render_frame(replace(scene, sensor=sensor), CLEAN, COUNT, SIZE)
    assert passes["both"].plan.passes[-2:] == ("sharpening", "jpeg")
    np.testing.assert_array_equal(passes["sharp"].clean, sharpened(passes["none"].clean, 1.0))
    steps = {k: np.abs(np.diff(v.clean.astype(float), axis=1)).mean() for k, v in passes.items()}
    assert steps["sharp"] > 1.1 * steps["none"]
    assert steps["both"] > 1.05 * steps["none"]
