"""Motion: joint limits hold, headings mean what they say, left mirrors right."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_scene import SINGLE, SceneMaker

from hwp_bench.base.errors import BadInput
from hwp_bench.hands import load_template
from hwp_bench.hands.poses import LIMITS, finger_pose, gesture, gestures, within_limits
from hwp_bench.sim.light.lights import focus_point
from hwp_bench.sim.scene.scene import (
    HandMoment,
    hand_parameters,
    heading_matrix,
    intrinsics,
    pixel_rays,
    track_moment,
    viewmat,
)
from hwp_bench.sim.scene_files import parse_scene
from hwp_bench.sim.subject.hand import template_vertices


def test_named_gestures_are_within_the_limits() -> None:
    for name, angles in gestures().items():
        np.testing.assert_array_equal(within_limits(angles), angles, err_msg=name)
    with pytest.raises(BadInput, match="fist"):
        gesture("fits")


@given(st.floats(0.0, 200.0))
def test_the_track_never_leaves_the_limits(seconds: float) -> None:
    angles = track_moment(parse_scene(SINGLE, where="tiny"), "right", seconds).angles
    assert (angles[0] >= LIMITS[0][:, 0]).all()
    assert (angles[0] <= LIMITS[0][:, 1]).all()
    assert (angles[1:] >= LIMITS[1][:, 0]).all()
    assert (angles[1:] <= LIMITS[1][:, 1]).all()


def test_rounds_differ_but_repeat_exactly(make_scene: SceneMaker) -> None:
    scene = make_scene()
    first, second = (track_moment(scene, "right", t) for t in (0.2, 0.2 + scene.track.period))
    assert np.abs(first.angles - second.angles).max() > 1.0
    np.testing.assert_array_equal(first.angles, track_moment(scene, "right", 0.2).angles)


@pytest.mark.parametrize("side", ["right", "left"])
def test_heading_zero_shows_the_back_with_fingers_up(side: str) -> None:
    template = load_template("anny", side)
    moment = HandMoment(gesture("flat"), np.zeros(3), np.zeros(3))
    pose, transl = hand_parameters(moment, side, template.joints)
    vertices = template_vertices(template.to_torch(), pose, np.zeros(10), transl)
    tips = vertices[template.fingertips]
    assert tips[2, 1] < vertices[:, 1].mean() - 0.05  # up is -y
    thumb_side = -1.0 if side == "right" else 1.0
    assert np.sign(tips[0, 0]) == thumb_side
    # The palm is at the point looked at; the mean of all vertices lies towards the fingers.
    assert np.linalg.norm(vertices.mean(axis=0) - focus_point()) < 0.07


@pytest.mark.parametrize("side", ["right", "left"])
def test_headings_are_rotations(side: str) -> None:
    turn = heading_matrix(np.array([30.0, -20.0, 10.0]), side)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    # The left rest hand is a mirror image, but its rotation is a proper one all the same.
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_flexion_brings_the_tips_to_the_palm() -> None:
    template = load_template("anny", "right")
    reach = {}
    for name in ("flat", "fist"):
        pose = np.vstack([np.zeros((1, 3)), finger_pose(gesture(name), template.joints)])
        vertices = template_vertices(template.to_torch(), pose, np.zeros(10), np.zeros(3))
        tips = vertices[template.fingertips[1:]]
        reach[name] = np.linalg.norm(tips - template.joints[0], axis=1)
    assert (reach["fist"] < 0.75 * reach["flat"]).all()


def test_rays_go_through_their_pixels(make_scene: SceneMaker) -> None:
    scene = make_scene()
    K, view = intrinsics(scene, 64), viewmat(scene, 1.3)
    origin, directions = pixel_rays(K, view, (10, 20, 30, 36), 1)
    point = origin + 0.7 * directions[3, 2]
    x, y, z = view[:3, :3] @ point + view[:3, 3]
    pixel = K @ np.array([x / z, y / z, 1.0])
    np.testing.assert_allclose(pixel[:2], [32.5, 13.5], atol=1e-9)
    assert z == pytest.approx(0.7)
