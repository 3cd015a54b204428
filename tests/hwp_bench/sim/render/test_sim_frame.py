"""Frames: only what the recipe calls for is rendered, and it is what the recipe says.

Oracles: the scene without an effect (bit for bit), counts of rays, and energy conservation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tiny_scene import BLUR, CLEAN, LIGHT, OBJECT, SceneMaker

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.tables import to_markdown
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.sim.effects import SUBFRAME_STEP, plan_frame
from hwp_bench.sim.produce.capture import true_hands
from hwp_bench.sim.produce.forecast import forecast, plan_table
from hwp_bench.sim.props.objects import build_object
from hwp_bench.sim.render.frame import CHANNELS, SimulatedFrame, frame_layers, render_frame
from hwp_bench.sim.scene.scene import intrinsics, viewmat, with_effects
from hwp_bench.sim.sensor import AutoControl, Sensor

COUNT, SIZE = 40, 48


@pytest.fixture
def render(make_scene: SceneMaker) -> Callable[[int], SimulatedFrame]:
    scene = make_scene()
    return lambda frame: render_frame(scene, frame, COUNT, SIZE)


def test_a_frame_shows_a_hand(render: Callable[[int], SimulatedFrame]) -> None:
    result = render(CLEAN)
    assert result.rgb.shape == (SIZE, SIZE, 3)
    assert 0.1 < result.coverage.mean() < 0.6
    assert result.coverage.max() == 1.0
    hand = result.rgb[result.coverage == 1.0].astype(float)
    assert hand[:, 0].mean() > hand[:, 1].mean() > hand[:, 2].mean()
    assert hand.std() > 5.0


def test_an_unperturbed_frame_is_its_clean_version(
    render: Callable[[int], SimulatedFrame],
) -> None:
    result = render(CLEAN)
    assert result.plan.passes == ("hands", "shadow", "sky", "backdrop", "sensor")
    assert set(result.cost.rays) == {"hands", "shadow", "sky"}
    np.testing.assert_array_equal(result.rgb, result.clean)


@pytest.mark.parametrize(
    ("frame", "kind", "extra"),
    [
        (OBJECT, "hand_object_interaction", "objects"),
        (LIGHT, "illumination", "light"),
        (BLUR, "motion_blur", "shutter"),
    ],
)
def test_an_effect_changes_its_frames_and_no_other(
    make_scene: SceneMaker, frame: int, kind: str, extra: str
) -> None:
    scene = make_scene()
    with_it = render_frame(scene, frame, COUNT, SIZE)
    assert extra in with_it.plan.passes
    assert (with_it.rgb != with_it.clean).mean() > 0.02
    without = with_effects(scene, [call.kind for call in scene.effects if call.kind != kind])
    bare = render_frame(without, frame, COUNT, SIZE)
    np.testing.assert_array_equal(bare.rgb, bare.clean)
    for other in {CLEAN, OBJECT, LIGHT, BLUR} - {frame}:
        before = render_frame(scene, other, COUNT, SIZE)
        after = render_frame(without, other, COUNT, SIZE)
        np.testing.assert_array_equal(before.rgb, after.rgb)
        np.testing.assert_array_equal(before.coverage, after.coverage)
        assert before.cost.rays == after.cost.rays


def test_the_first_validation_frame_is_clean_though_an_episode_reaches_into_it(
    make_scene: SceneMaker,
) -> None:
    # Oracle: the scene without effects. The first of 12 frames that validates is that at 0.75.
    scene = make_scene(
        ('kind = "illumination"\n', 'kind = "complex_poses"\nright = [{ gesture = "claw" }]\n'),
        ("[[0.3, 0.4, 3]]", "[[0.6, 0.799, 5]]"),
        ("[[0.5, 0.6, 3]]", "[[0.6, 0.799, 5]]"),
    )
    bare = with_effects(scene, ())
    first = contiguous_split(scene.id, 12).validation[0]
    plans = [plan_frame(scene, frame, 12, SIZE) for frame in range(12)]
    assert set(plans[first - 1].strength) == {"complex_poses", "motion_blur"}
    assert plans[first].severity == {call.kind: 0 for call in scene.effects}
    shown, expected = (render_frame(each, first, 12, SIZE) for each in (scene, bare))
    np.testing.assert_array_equal(shown.rgb, expected.rgb)
    np.testing.assert_array_equal(shown.clean, expected.clean)
    poses = [true_hands(each, plans)["right"].pose for each in (scene, bare)]
    assert (poses[0][first - 1] != poses[1][first - 1]).any()
    np.testing.assert_array_equal(poses[0][first:], poses[1][first:])


def test_rays_are_those_of_the_passes(render: Callable[[int], SimulatedFrame]) -> None:
    clean, thing, blurred = (render(frame).cost.rays for frame in (CLEAN, OBJECT, BLUR))
    assert clean["objects"] == blurred["objects"] == 0 < thing["objects"]
    assert thing["sky"] == clean["sky"] == blurred["sky"]
    # A frame with an object is cast twice: once clean, once with it.
    assert thing["hands"] > 1.5 * thing["objects"] > 0
    # A sub-frame casts one ray a pixel, the clean instant four.
    recipe = render(BLUR).plan
    assert recipe.subframes >= 4
    assert blurred["hands"] < (4 + 2 * recipe.subframes) * SIZE * SIZE


def test_subframes_follow_the_motion_on_the_screen(make_scene: SceneMaker) -> None:
    scene = make_scene()
    counts = [
        plan_frame(scene, BLUR, COUNT, 256, {"motion_blur": strength}).subframes
        for strength in (0.001, 0.02, 0.04, 0.08)
    ]
    assert counts == sorted(counts)
    assert counts[-1] >= 0.08 * 256 / SUBFRAME_STEP / 1.5
    assert plan_frame(scene, CLEAN, COUNT, 256).subframes == 1


def test_blur_moves_light_but_makes_none(make_scene: SceneMaker) -> None:
    # Oracle: the exposure is a mean of instants, so the image's mean hardly changes.
    scene = replace(make_scene(), sensor=Sensor(noise=0.0))
    result = render_frame(scene, BLUR, COUNT, SIZE)
    assert abs(result.rgb.mean() - result.clean.mean()) < 0.04 * result.clean.mean()
    # A smeared edge has the same step in all, but spread over more pixels: smaller squares.
    steepness = [
        sum(float(np.square(np.diff(image.astype(float), axis=axis)).sum()) for axis in (0, 1))
        for image in (result.rgb, result.clean)
    ]
    assert steepness[0] < steepness[1]
    partial = (result.coverage > 0.02) & (result.coverage < 0.98)
    clean_partial = (result.clean_coverage > 0.02) & (result.clean_coverage < 0.98)
    assert partial.sum() > clean_partial.sum()


def test_an_object_covers_what_the_mask_loses(render: Callable[[int], SimulatedFrame]) -> None:
    result = render(OBJECT)
    lost = result.clean_coverage - result.coverage
    assert lost.min() > -1e-9
    assert lost.sum() > 5.0


def test_dimming_is_a_factor_on_linear_light(make_scene: SceneMaker) -> None:
    from hwp_bench.base.colors import srgb_to_linear

    scene = replace(make_scene(), sensor=Sensor(noise=0.0))
    result = render_frame(scene, LIGHT, COUNT, SIZE)
    bright = srgb_to_linear(result.clean / 255.0)
    dim = srgb_to_linear(result.rgb / 255.0)
    ratio = dim[bright > 0.1] / bright[bright > 0.1]
    expected = 2.0 ** -result.plan.strength["illumination"]
    np.testing.assert_allclose(np.median(ratio), expected, rtol=0.02)


@pytest.mark.parametrize("auto", [None, AutoControl(level=0.1)])
def test_linear_layers_hold_the_light_of_the_frame(
    make_scene: SceneMaker, auto: AutoControl | None
) -> None:
    # Oracle: a frame without noise. Under the sky alone much of the shading is occlusion.
    scene = make_scene()
    light = replace(scene.light, key=0.0, sky=0.6)
    scene = replace(scene, sensor=Sensor(noise=0.0, auto=auto), light=light)
    result = render_frame(scene, CLEAN, COUNT, SIZE)
    found = frame_layers(scene, result, COUNT, SIZE)[..., :3]
    hand = result.clean_coverage == 1.0
    expected = srgb_to_linear(result.clean / 255.0)[hand].mean(axis=0)
    np.testing.assert_allclose(found[hand].mean(axis=0), expected, rtol=0.02)


def test_the_backdrop_moves_as_the_camera_turns(make_scene: SceneMaker) -> None:
    # Oracle: where a pixel of the backdrop is then, the camera looks in the direction of now.
    scene = make_scene()
    result = render_frame(scene, CLEAN, COUNT, SIZE)
    layers = frame_layers(scene, result, COUNT, SIZE)
    behind = layers[..., CHANNELS.index("id")] == 0.0
    motion = layers[..., -2:][behind]
    K, now = intrinsics(scene, SIZE), result.plan.seconds
    places = np.argwhere(behind)[:, ::-1] + 0.5

    def looked_at(places: np.ndarray, seconds: float) -> np.ndarray:
        rays = np.column_stack([places, np.ones(len(places))]) @ np.linalg.inv(K).T
        world = rays @ viewmat(scene, seconds)[:3, :3]
        return world[:, :2] / world[:, 2:]

    later = now + scene.duration / COUNT
    np.testing.assert_allclose(
        looked_at(places + motion, later), looked_at(places, now), rtol=0, atol=1e-6
    )
    assert np.abs(motion).mean() > 0.01
    still = make_scene(("handheld = true", "handheld = false"))
    layers = frame_layers(still, render_frame(still, CLEAN, COUNT, SIZE), COUNT, SIZE)
    assert (layers[..., -2:][layers[..., CHANNELS.index("id")] == 0.0] == 0.0).all()


@pytest.mark.parametrize(("frame", "above"), [(2, 0.0), (7, 0.5), (8, 0.0)])
def test_an_object_moves_as_it_comes_and_goes(
    make_scene: SceneMaker, frame: int, above: float
) -> None:
    # Oracle: the points that pixels show, shifted by the change of strength. Before frame 8 the
    # strength falls below 0.5, and after it the episode is over.
    scene = make_scene(('anchor = "right"', f'anchor = "world"\nabove = {above}'))
    result = render_frame(scene, frame, COUNT, SIZE)
    layers = frame_layers(scene, result, COUNT, SIZE).astype(float)
    shown = layers[..., CHANNELS.index("id")] == 4.0
    K, now = intrinsics(scene, SIZE), result.plan.seconds
    rays = np.column_stack([np.argwhere(shown)[:, ::-1] + 0.5, np.ones(shown.sum())])
    points = rays @ np.linalg.inv(K).T * layers[shown][:, [CHANNELS.index("Z")]]
    view, later = (viewmat(scene, at) for at in (now, now + scene.duration / COUNT))
    world = (points - view[:3, 3]) @ view[:3, :3]
    before = result.plan.strength["hand_object_interaction"]
    after = plan_frame(scene, frame + 1, COUNT, SIZE).strength
    change = after.get("hand_object_interaction", before) - before
    moved = (world - change * np.array([0.05, 0.0, 0.0])) @ later[:3, :3].T + later[:3, 3]
    expected = (moved @ K.T)[:, :2] / moved[:, 2:] - rays[:, :2]
    np.testing.assert_allclose(layers[shown][:, -2:], expected, rtol=0, atol=1e-3)
    assert (np.abs(expected[:, 0]).mean() > 2.0) == (frame < 8)


def test_frames_depend_on_the_seed_alone(make_scene: SceneMaker) -> None:
    first = render_frame(make_scene(), OBJECT, COUNT, SIZE)
    again = render_frame(make_scene(), OBJECT, COUNT, SIZE)
    other = render_frame(make_scene(("seed = 5\n", "seed = 6\n")), OBJECT, COUNT, SIZE)
    np.testing.assert_array_equal(first.rgb, again.rgb)
    assert (first.rgb != other.rgb).any()


def test_a_scene_without_objects_builds_none(make_scene: SceneMaker) -> None:
    build_object.cache_clear()
    render_frame(with_effects(make_scene(), ["illumination"]), LIGHT, COUNT, SIZE)
    assert build_object.cache_info().misses == 0
    render_frame(make_scene(), OBJECT, COUNT, SIZE)
    assert build_object.cache_info().misses > 0


def test_the_forecast_counts_clean_frames_of_the_training_part(make_scene: SceneMaker) -> None:
    # Of the 9 training frames of 12, at 0, 1/12, ... 8/12, effects leave 0, 3, 5 and 8.
    assert forecast(make_scene(), 12, SIZE, probe=False).clean_frames == 4


def test_the_forecast_is_the_sum_of_what_is_called_for(make_scene: SceneMaker) -> None:
    scene = make_scene()
    report = forecast(scene, COUNT, SIZE)
    assert report.passes["hands"] == COUNT
    assert report.passes["objects"] == report.groups["hand_object_interaction"]
    assert sum(report.groups.values()) == COUNT
    assert report.rays is not None
    clean = render_frame(scene, CLEAN, COUNT, SIZE).cost.rays.total()
    # Clean frames differ in pose only; their rays differ by how much of the image they fill.
    assert 0.5 < report.rays["clean"] / (report.groups["clean"] * clean) < 2.0
    assert "| tiny | clean |" in to_markdown(plan_table([report]))
    shares, seconds = report.shares(), report.seconds
    assert shares is not None
    assert seconds is not None
    assert set(shares) == {"clean", *(call.kind for call in scene.effects)}
    assert sum(shares.values()) == pytest.approx(sum(seconds.values()))
