"""Lamps, windows and walls. Oracles: the inverse-square law, closed forms and the sky's own light.

A scene that asks for none of them is in `test_sim_sensor` (digest) and `test_sim_frame` (rays).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_surface import facing_camera
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import BLUR, CLEAN, LIGHT, OBJECT, SceneMaker

from hwp_bench.sim.effects import lights_at, plan_frame
from hwp_bench.sim.geometry.surface import LIFT, RenderCost, Surface, Tracer, plain
from hwp_bench.sim.light.lights import (
    BORDER_SHARE,
    FACING_SHARE,
    CastShadow,
    Lamp,
    Lights,
    Room,
    area_light,
    focus_point,
    steady_light,
    wall_irradiance,
    wall_radiance,
)
from hwp_bench.sim.light.shading import GRIDS, SKIN_REACH, Samples, lamp_light, room_light
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.scene_files import load_scene
from hwp_bench.sim.sensor import AutoControl, Sensor

COUNT, SIZE = 40, 48
FAR_TURN = np.zeros(1, dtype=np.int64)


def _samples(points: np.ndarray, normals: np.ndarray) -> Samples:
    """White, matt points that face the camera along their normals."""
    count = len(points)
    return Samples(
        ray=np.arange(count),
        distance=np.ones(count),
        points=points,
        normals=normals,
        flat=normals,
        view=normals,
        albedo=np.ones((count, 3), dtype=np.float32),
        roughness=np.ones(count, dtype=np.float32),
        specular=np.zeros(count, dtype=np.float32),
        wrap=np.zeros((count, 3), dtype=np.float32),
        glow=np.zeros(count, dtype=np.float32),
        openness=np.ones(count),
        hand=np.ones(count, dtype=bool),
    )


def _tracer(surface: Surface | None = None) -> Tracer:
    """Rays against a surface, or against a triangle that no ray here meets."""
    if surface is None:
        vertices = np.array([1e4, -7e3, 3e3]) + np.eye(3)
        return Tracer(vertices, np.array([[0, 1, 2]]), RenderCost().rays)
    return Tracer(surface.vertices, surface.faces, RenderCost().rays)


def _dark(**more: object) -> Lights:
    zero = np.zeros(3)
    lights = Lights(direction=np.array([0.0, -1.0, 0.0]), key=zero, sky=zero, ground=zero)
    return replace(lights, **more)  # type: ignore[arg-type]


@settings(max_examples=30, deadline=None)
@given(
    place=st.tuples(*[st.floats(-2.0, 2.0)] * 3).filter(lambda p: np.linalg.norm(p) > 0.3),
    ahead=st.floats(-0.15, 0.15),
)
def test_a_small_lamp_follows_the_inverse_square(
    place: tuple[float, float, float], ahead: float
) -> None:
    # Oracle: strength (d0 / d)^2 on a surface that faces the lamp; a lamp of 5 mm is a point.
    lamp = area_light(Lamp(place=place, strength=0.8, width=0.005))
    way = np.array(place) / np.linalg.norm(place)
    points = focus_point() + ahead * way[None]
    lights = _dark(lamps=(lamp,), exposure=2.0)
    seen = lamp_light(_samples(points, way[None]), lights, [_tracer()], FAR_TURN)
    distance = np.linalg.norm(place)
    expected = 2.0 * 0.8 * (distance / (distance - ahead)) ** 2 * lamp.irradiance / 0.8
    np.testing.assert_allclose(seen[0], expected, rtol=1e-3)


def test_a_lamp_lights_no_point_in_its_own_place() -> None:
    # A lamp one metre behind the hand lies where the backdrop's light is asked for.
    light = area_light(Lamp(place=(0.0, 0.0, 1.0), strength=1.0))
    np.testing.assert_array_equal(light.at(light.centre, np.array([0.0, 0.0, -1.0])), 0.0)


def test_a_window_is_the_integral_over_its_area() -> None:
    # Oracle: the four samples of a pixel against 200 x 200 points of the same rectangle.
    lamp = area_light(Lamp(place=(-0.8, 0.0, -0.3), strength=1.0, width=1.2))
    normal = np.array([-0.5, -0.7, -0.5]) / np.linalg.norm([0.5, 0.7, 0.5])
    points = np.repeat(focus_point()[None] + [[0.03, 0.02, 0.0]], 4, axis=0)
    lights = _dark(lamps=(lamp,))
    seen = lamp_light(
        _samples(points, np.repeat(normal[None], 4, 0)), lights, [_tracer()], np.arange(4)
    ).mean(axis=0)
    ticks = (np.arange(200) + 0.5) / 100 - 1.0
    a, b = (grid.ravel()[:, None] for grid in np.meshgrid(ticks, ticks))
    ways = lamp.centre + a * lamp.across + b * lamp.down - points[0]
    squared = (ways**2).sum(axis=1)
    unit = ways / np.sqrt(squared)[:, None]
    share = np.clip(unit @ normal, 0, 1) * np.clip(-unit @ lamp.facing, 0, 1)
    expected = (share * lamp.distance**2 / squared).mean() * lamp.irradiance
    np.testing.assert_allclose(seen, expected, rtol=0.02)


def test_small_lamps_throw_hard_shadows_and_windows_soft_ones() -> None:
    # Oracle: similar triangles. The penumbra of an edge is size / distance * gap wide.
    gap, distance = 0.05, 0.5
    edge = Surface(
        vertices=np.array([[-1, -1, -gap], [0, -1, -gap], [0, 1, -gap], [-1, 1, -gap]], float)
        + focus_point(),
        normals=np.tile([0.0, 0.0, -1.0], (4, 1)),
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        corner_uv=np.zeros((2, 3, 2)),
        material=np.zeros(2, dtype=np.int64),
        materials=(plain((0.5, 0.5, 0.5)),),
        hand=np.ones(2, dtype=bool),
        openness=np.ones(4),
    )
    across = np.linspace(-0.06, 0.06, 241)
    points = focus_point() + np.stack([across, 0 * across, 0 * across], axis=1)
    normals = np.tile([0.0, 0.0, -1.0], (len(across), 1))
    for width in (0.01, 0.1, 0.5):
        lamp = Lamp(place=(0.0, 0.0, -distance), strength=1.0, width=width)
        lights = _dark(lamps=(area_light(lamp),))
        light = sum(
            lamp_light(
                _samples(points, normals), lights, [_tracer(edge)], np.full(len(across), turn)
            )[:, 1]
            for turn in range(4)
        )
        partly = across[(light > 0.01 * light.max()) & (light < 0.97 * light.max())]
        penumbra = width * gap / (distance - gap)
        # Points of the lamp stand half a step inside its edge, at 2, 4 or 6 across it.
        steps = 2 * next(n for limit, n in GRIDS if width / distance <= limit)
        expected = penumbra * (1.0 - 1.0 / steps)
        assert np.ptp(partly) == pytest.approx(expected, abs=0.002 + 0.1 * penumbra)


def test_white_walls_are_a_white_sky_and_shares_add_up() -> None:
    assert pytest.approx(0.5541, abs=1e-4) == FACING_SHARE
    assert pytest.approx(1.0) == FACING_SHARE + 4 * BORDER_SHARE
    white = Room(**dict.fromkeys(("left", "right", "ceiling", "floor", "far", "near"), (1, 1, 1)))
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.repeat(focus_point()[None], 50, axis=0)
    seen = room_light(_samples(points, normals), _dark(room=wall_radiance(white, 0.7)))
    np.testing.assert_allclose(seen, 0.7, rtol=1e-6)
    red = wall_radiance(replace(white, left=(1.0, 0.0, 0.0)), 1.0)
    towards = wall_irradiance(red)
    np.testing.assert_allclose(towards[1], [1.0, 1 - FACING_SHARE, 1 - FACING_SHARE], atol=1e-12)
    np.testing.assert_allclose(towards[0], 1.0)


def test_a_scene_pays_for_what_it_asks(make_scene: SceneMaker) -> None:
    lines = "[[light.lamps]]\nplace = [-0.8, 0.0, 0.0]\nstrength = 1.0\nwidth = 0.8\n"
    bare = make_scene()
    lit = make_scene(("[track]", f"{lines}[light.room]\nleft = [0.9, 0.1, 0.1]\n[track]"))
    assert set(lit.to_json()["light"]) - set(bare.to_json()["light"]) == {"lamps", "room"}
    assert plan_frame(lit, CLEAN, COUNT, SIZE).passes[4:6] == ("lamps", "room")
    before, after = (render_frame(scene, CLEAN, COUNT, SIZE) for scene in (bare, lit))
    assert before.cost.rays["lamps"] == 0 < after.cost.rays["lamps"]
    assert {"lamps", "room"} <= set(after.cost.seconds)
    # A key light that is off casts no ray.
    off = replace(lit, light=replace(lit.light, key=0.0))
    assert render_frame(off, CLEAN, COUNT, SIZE).cost.rays["shadow"] == 0


def test_the_first_moment_of_an_episode_has_its_own_mode() -> None:
    # Frame 168 of 800 begins the second episode, at 0.21; as seconds over the duration it is a
    # last bit earlier. Its mode, warm, tints the light; that of the first episode swings it.
    scene = load_scene("wild-test-2")
    call = scene.effect("illumination")
    assert call is not None
    assert call.episodes[1].start == 0.21
    assert call.settings["modes"][:2] == ["move", "warm"]
    recipe = plan_frame(scene, 168, 800, SIZE)
    assert recipe.seconds / scene.duration < 0.21
    lights, steady = lights_at(scene, recipe), steady_light(scene.light)
    np.testing.assert_array_equal(lights.direction, steady.direction)
    assert lights.key[0] / lights.key[2] > 1.02 * steady.key[0] / steady.key[2]


def test_effects_change_lamps_too(make_scene: SceneMaker) -> None:
    lamp = Lamp(place=(-0.8, 0.0, 0.0), strength=1.0, width=0.4)
    scene = make_scene()
    light = replace(scene.light, key=0.0, sky=0.1, lamps=(lamp,), room=Room())
    scene = replace(scene, light=light, sensor=Sensor(noise=0.0))
    for frame in (LIGHT, OBJECT):
        result = render_frame(scene, frame, COUNT, SIZE)
        assert (result.rgb != result.clean).any()
    steady = steady_light(light)
    warm = steady.tinted(np.array([2.0, 1.0, 0.5]))
    np.testing.assert_allclose(warm.lamps[0].irradiance, steady.lamps[0].irradiance * [2, 1, 0.5])
    assert lights_at(scene, plan_frame(scene, CLEAN, COUNT, SIZE)).lamps[0].slope == pytest.approx(
        0.5
    )


def test_a_light_behind_the_hand_leaves_it_dark_with_a_rim_on_its_side(
    make_scene: SceneMaker,
) -> None:
    scene = replace(make_scene(), sensor=Sensor(noise=0.0))

    def seen(place: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
        lamp = Lamp(place=place, strength=3.0, width=0.3)
        light = replace(scene.light, key=0.0, sky=0.05, lamps=(lamp,), backdrop=4.0)
        result = render_frame(replace(scene, light=light), CLEAN, COUNT, 64)
        return result.clean.mean(axis=2), result.clean_coverage

    front, coverage = seen((0.0, -0.2, -0.7))
    left, right = (seen((x, -0.2, 0.45))[0] for x in (-0.5, 0.5))
    hand = coverage > 0.999
    for image in (left, right):
        assert np.median(image[hand]) < 0.5 * np.median(front[hand])
        assert image[coverage == 0].mean() > 1.5 * np.median(image[hand])
    rows = np.flatnonzero(hand[:56].any(axis=1))
    first = np.array([np.flatnonzero(hand[row])[0] for row in rows])
    last = np.array([np.flatnonzero(hand[row])[-1] for row in rows])
    assert left[rows, first].mean() > 1.3 * right[rows, first].mean()
    assert right[rows, last].mean() > 1.3 * left[rows, last].mean()


def test_lights_and_sensors_combine(make_scene: SceneMaker) -> None:
    # Oracle: a frame in which no effect acts is its clean version, and repeats bit for bit.
    scene = make_scene()
    lamp = Lamp(place=(-0.8, 0.0, 0.0), strength=1.0, width=0.4)
    sensor = Sensor(
        noise=0.01,
        jpeg_quality=70,
        rolling_shutter=0.02,
        sharpening=1.0,
        auto=AutoControl(lag=2.0),
    )
    light = replace(scene.light, lamps=(lamp,), room=Room(left=(0.9, 0.2, 0.1)))
    scene = replace(scene, light=light, sensor=sensor)
    wanted = ("lamps", "room", "rolling", "auto", "sensor", "sharpening", "jpeg")
    for frame in (CLEAN, BLUR):
        passes = plan_frame(scene, frame, COUNT, SIZE).passes
        assert tuple(name for name in passes if name in wanted) == wanted
        first, second = (render_frame(scene, frame, COUNT, SIZE) for _ in range(2))
        np.testing.assert_array_equal(first.rgb, second.rgb)
        assert (frame == CLEAN) == np.array_equal(first.rgb, first.clean)


def _walls(depths: tuple[float, ...]) -> Surface:
    """Large squares across the line of sight, some metres behind the point looked at."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    vertices = np.concatenate([corners + focus_point() + [0, 0, depth] for depth in depths])
    faces = np.concatenate(
        [4 * index + np.array([[0, 1, 2], [0, 2, 3]]) for index in range(len(depths))]
    )
    return facing_camera(vertices, faces)


@pytest.mark.parametrize("thickness", [0.002, 0.006])
def test_light_passes_through_thin_skin_and_reddens(thickness: float) -> None:
    # Oracle: Beer and Lambert on a slab. The ray starts twice its lift inside the skin.
    lamp = area_light(Lamp(place=(0.0, 0.0, 0.6), strength=1.0, width=0.01, through=1.0))
    facing = np.array([[0.0, 0.0, -1.0]])
    samples = _samples(focus_point()[None], facing)
    slab = _tracer(_walls((0.0, thickness)))
    lights = _dark(lamps=(lamp,))
    seen = lamp_light(samples, lights, [slab], FAR_TURN)[0]
    expected = np.exp(-(thickness - 2.0 * LIFT) / np.array(SKIN_REACH)) * lamp.irradiance
    np.testing.assert_allclose(seen, expected, rtol=0.02)
    assert seen[0] > seen[1] > seen[2]
    # A finger behind the slab, or a lamp that passes through nothing, leaves it dark.
    double = _tracer(_walls((0.0, thickness, 0.1, 0.11)))
    assert lamp_light(samples, lights, [double], FAR_TURN).max() == 0.0
    opaque = _dark(lamps=(replace(lamp, through=0.0),))
    assert lamp_light(samples, opaque, [slab], FAR_TURN).max() == 0.0
    # A shadow takes its share of it.
    for depth in (0.5, 1.0):
        cast = CastShadow(np.array([1.0, 0.0, 0.0]), edge=-1.0, width=0.03, depth=depth)
        shaded = lamp_light(samples, _dark(lamps=(lamp,), cast=cast), [slab], FAR_TURN)[0]
        np.testing.assert_allclose(shaded, (1.0 - depth) * seen, atol=1e-12)
