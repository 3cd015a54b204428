"""What is behind the hands: only where a scene asks for it, moving, and never on the hand.

Oracles: the same scene without it, bit for bit on the hand's own pixels; the order of skin's
channels; and the time at which something is seen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import BLUR, CLEAN, SceneMaker

from hwp_bench.sim.effects import plan_frame
from hwp_bench.sim.props import behind as planes
from hwp_bench.sim.props.behind import (
    NOTHING,
    Behind,
    Clutter,
    Face,
    OtherArm,
    backdrop_colors,
    draw_behind,
    plane_names,
)
from hwp_bench.sim.render.frame import SimulatedFrame, render_frame
from hwp_bench.sim.scene.scene import Scene, intrinsics, pixel_rays
from hwp_bench.sim.scene_files import load_scene
from hwp_bench.sim.sensor import Sensor

SIZE = 48
EVERYTHING = Behind(Clutter(count=5), Face(), OtherArm())


def frame(scene: Scene, number: int = CLEAN) -> SimulatedFrame:
    return render_frame(replace(scene, sensor=Sensor(noise=0.0)), number, 40, SIZE)


def drawn_behind(scene: Scene, ways: np.ndarray, seconds: float, image: np.ndarray) -> np.ndarray:
    view, tone = scene.camera.field_of_view, scene.subject.tone
    return draw_behind(scene.behind, tone, view, ways, seconds, image)


def directions(scene: Scene, size: int = SIZE) -> np.ndarray:
    return pixel_rays(intrinsics(scene, size), np.eye(4), (0, size, 0, size), 1)[1]


def test_nothing_behind_leaves_no_trace(make_scene: SceneMaker) -> None:
    scene = make_scene()
    assert scene.behind == NOTHING
    assert "behind" not in scene.to_json()
    assert make_scene(("[camera]", "[behind]\n\n[camera]")).digest == scene.digest
    asked = make_scene(("[camera]", "[behind.face]\nseed = 3\n\n[camera]"))
    assert asked.behind == Behind(face=Face(seed=3))
    assert asked.digest != scene.digest
    passes = plan_frame(replace(scene, behind=EVERYTHING), CLEAN, 40, SIZE).passes
    assert passes[4:] == ("clutter", "face", "other_arm", "sensor")


@pytest.mark.parametrize(
    "behind", [Behind(clutter=Clutter()), Behind(face=Face()), Behind(arm=OtherArm())]
)
def test_what_is_behind_changes_no_pixel_of_the_hand(
    make_scene: SceneMaker, behind: Behind
) -> None:
    scene = make_scene()
    before, after = frame(scene), frame(replace(scene, behind=behind))
    np.testing.assert_array_equal(before.coverage, after.coverage)
    hand = before.coverage == 1.0
    np.testing.assert_array_equal(before.rgb[hand], after.rgb[hand])
    # The clean version shows it too, and it covers a fair part of the picture.
    np.testing.assert_array_equal(after.rgb, after.clean)
    free = before.coverage == 0.0
    assert (before.rgb[free] != after.rgb[free]).any(axis=1).mean() > 0.04


def test_it_moves_with_the_time_of_the_capture_and_repeats(make_scene: SceneMaker) -> None:
    scene = replace(make_scene(), behind=EVERYTHING)
    rays = directions(scene)
    still = np.full((SIZE, SIZE, 3), 0.4)
    first, again, later = (drawn_behind(scene, rays, t, still) for t in (0.2, 0.2, 1.4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - later).mean() > 0.01
    np.testing.assert_array_equal(still, 0.4)


def test_the_shutter_smears_what_moves(make_scene: SceneMaker) -> None:
    fast = Behind(clutter=Clutter(count=10, speed=3.0))
    scene = replace(make_scene(), behind=fast)
    result = frame(scene, BLUR)
    assert "shutter" in result.plan.passes
    free = (result.coverage == 0.0) & (result.clean_coverage == 0.0)
    assert (result.rgb[free] != result.clean[free]).any(axis=1).mean() > 0.05


@settings(max_examples=12, deadline=None)
@given(
    seconds=st.floats(0.0, 1e4),
    seed=st.integers(0, 2**31),
    count=st.integers(1, 60),
    size=st.floats(0.1, 3.0),
    tone=st.floats(-0.4, 1.4),
)
def test_colours_stay_in_range_at_any_time(
    seconds: float, seed: int, count: int, size: float, tone: float
) -> None:
    behind = Behind(
        Clutter(count=count, seed=seed),
        Face(tone=tone, seed=seed % 5, size=size),
        OtherArm(tone=tone, seed=seed, side="right"),
    )
    scene = replace(load_scene("capture0"), behind=behind)
    drawn = drawn_behind(scene, directions(scene, 24), seconds, np.full((24, 24, 3), 0.5))
    assert np.isfinite(drawn).all()
    assert 0.0 <= drawn.min() <= drawn.max() <= 1.5


def test_a_face_has_skin_eyes_and_a_mouth() -> None:
    from hwp_bench.sim.props.behind import _COLUMNS, _FRAME, _ROWS, face_picture

    def at(picture: np.ndarray, u: float, v: float) -> np.ndarray:
        column = (u - _FRAME[0]) / (_FRAME[1] - _FRAME[0]) * (_COLUMNS - 1)
        row = (v - _FRAME[2]) / (_FRAME[3] - _FRAME[2]) * (_ROWS - 1)
        return picture[round(row), round(column)]

    for seed in range(3):
        seen, closed = (face_picture((0.83, 0.63, 0.5), seed, shut) for shut in (False, True))
        cheek = at(seen, 0.35, 0.2)
        assert cheek[0] > cheek[1] > cheek[2] > 0.0
        assert cheek[3] == pytest.approx(1.0, abs=1e-3)
        for side in (-1.0, 1.0):
            assert at(seen, 0.29 * side, -0.09)[:3].mean() < 0.7 * cheek[:3].mean()
            shut = at(closed, 0.29 * side, -0.16)[:3].mean()
            assert shut > at(seen, 0.29 * side, -0.12)[:3].mean()
        lips = at(seen, 0.0, 0.46)
        assert lips[1] / lips[0] < 0.9 * cheek[1] / cheek[0]
        assert at(seen, -1.25, -1.15)[3] < 0.01


@pytest.mark.parametrize("name", plane_names())
def test_planes_have_the_colours_of_skin(
    make_scene: SceneMaker, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    assert make_scene(('background = "studio"', f'background = "{name}"')).background == name
    # Coarser than in a frame: colours and patterns are the same.
    monkeypatch.setattr(planes, "PLANE_TEXTURE", 256)
    seen, other = (planes.plane_texture(name, seed) for seed in (5, 6))
    red, green, blue = seen.mean(axis=(0, 1))
    assert red > 1.1 * green > 1.1 * 1.1 * blue
    assert seen.std(axis=(0, 1)).min() > 0.003
    assert np.abs(seen - other).mean() > 0.002


def test_a_plane_is_the_backdrop_of_its_name(make_scene: SceneMaker) -> None:
    rays = directions(make_scene())
    seen = backdrop_colors("beige_wall", 5, rays)
    middle = planes.plane_texture("beige_wall", 5)[planes.PLANE_TEXTURE // 2][:, 0]
    assert seen.shape == rays.shape
    assert seen[SIZE // 2, :, 0].min() >= 0.9 * middle.min()
    assert seen[SIZE // 2, :, 0].max() <= 1.1 * middle.max()
