"""A hand behind the camera, and one that reaches from behind it into the picture.

Oracles: the frame of a hand elsewhere behind the camera, bit for bit; and Moeller and Trumbore's
intersection of each ray with each triangle in float64, forwards alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_scene import BLUR, CLEAN, LIGHT, OBJECT, SceneMaker

from hwp_bench.sim.effects import hands_at, plan_frame
from hwp_bench.sim.geometry.surface import RenderCost, Surface
from hwp_bench.sim.light.lights import FOCUS_DISTANCE
from hwp_bench.sim.render.frame import SUPERSAMPLING, SimulatedFrame, render_frame
from hwp_bench.sim.render.stage import RenderStage
from hwp_bench.sim.scene.scene import Scene, intrinsics, pixel_rays, viewmat
from hwp_bench.sim.sensor import Sensor

COUNT, SIZE = 40, 12


def placed(make_scene: SceneMaker, x: float, z: float, tilt: float = 0.0) -> Scene:
    """The scene with its hand at (x, 0, z) m from the point looked at."""
    at = f"place = [{x}, 0.0, {z}], tilt = {tilt}"
    scene = make_scene(
        ('{ gesture = "open" }', f'{{ gesture = "open", {at} }}'),
        ('"fist", turn = 30.0', f'"open", {at}'),
    )
    return replace(scene, sensor=Sensor(noise=0.0))


@pytest.mark.parametrize("frame", [CLEAN, OBJECT, LIGHT, BLUR])
def test_a_hand_behind_the_camera_leaves_no_trace(make_scene: SceneMaker, frame: int) -> None:
    shown: list[SimulatedFrame] = [
        render_frame(placed(make_scene, x, -1.0), frame, COUNT, SIZE) for x in (0.0, 0.3)
    ]
    for result in shown:
        assert not result.coverage.any()
        assert not result.clean_coverage.any()
    np.testing.assert_array_equal(shown[0].rgb, shown[1].rgb)
    np.testing.assert_array_equal(shown[0].clean, shown[1].clean)


def first_is_hand(surface: Surface, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Whether the first triangle on each ray is hand: (N,) bool."""
    corners = surface.vertices[surface.faces].astype(np.float64)
    start, along, across = (
        corners[:, 0],
        corners[:, 1] - corners[:, 0],
        corners[:, 2] - corners[:, 0],
    )
    from_start = origin - start
    q = np.cross(from_start, along)
    answer = np.zeros(len(rays), bool)
    for index, ray in enumerate(rays):
        p = np.cross(ray, across)
        with np.errstate(all="ignore"):
            inverse = 1.0 / (along * p).sum(1)
            u, v = (from_start * p).sum(1) * inverse, q @ ray * inverse
            distance = (across * q).sum(1) * inverse
        met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
        if met.any():
            nearest = np.flatnonzero(met)[np.argmin(distance[met])]
            answer[index] = surface.hand[nearest] == 1
    return answer


def test_of_a_hand_around_the_camera_the_part_before_it_is_drawn(make_scene: SceneMaker) -> None:
    # Fingers point away from the camera, whose centre lies above the palm.
    scene = placed(make_scene, 0.05, -FOCUS_DISTANCE, tilt=50.0)
    result = render_frame(scene, CLEAN, COUNT, SIZE)
    seconds = plan_frame(scene, CLEAN, COUNT, SIZE).seconds
    surface = RenderStage(scene, RenderCost()).surface(hands_at(scene, seconds))
    view = viewmat(scene, seconds)
    depths = surface.vertices @ view[2, :3] + view[2, 3]
    assert depths.min() < -0.02
    assert depths.max() > 0.02
    origin, rays = pixel_rays(intrinsics(scene, SIZE), view, (0, SIZE, 0, SIZE), SUPERSAMPLING)
    hand = first_is_hand(surface, origin, rays.reshape(-1, 3)).reshape(rays.shape[:2])
    expected = hand.reshape(SIZE, SUPERSAMPLING, SIZE, SUPERSAMPLING).mean((1, 3))
    assert 0.02 < expected.mean() < 0.98
    # Embree decides in float32 at edges: one ray of the four in one pixel of a hundred may differ.
    assert np.abs(result.coverage - expected).max() <= 1.0 / SUPERSAMPLING**2 + 1e-12
    assert (result.coverage != expected).mean() <= 0.01
