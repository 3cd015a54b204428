"""Skin does not run through skin: how deep is measured, and bounded by what was measured.

Oracles: a sphere, whose depth is its radius less the distance from its centre; for gestures and
scenes what was measured of these frames, rounded up (`python -m benchmarks.simulation
--penetration 40` prints it of more); for two hands the signed distance to the nearest vertex of
the other one along its normal: hands are about 25 mm thick, soft, and may press 12 mm into each
other.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from benchmarks.penetration import (
    Segments,
    hand_penetration,
    mutual_penetration,
    scene_penetration,
    segments,
    self_penetration,
)
from hwp_bench.hands.poses import gestures
from hwp_bench.sim.effects import hands_at
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.render.stage import RenderStage
from hwp_bench.sim.scene.scene import HandKey, moment_of_key, scene_hands
from hwp_bench.sim.scene_files import load_scene, scene_names
from hwp_bench.sim.subject.hand import MOVING, SubjectHand

#: Deepest that any gesture presses a hand into itself, m: finger tips give way by a few
#: millimetres where a real palm does.
GESTURE_DEEPEST = 0.003
#: The same over the frames of the scenes, between two gestures, m.
SELF_DEEPEST = 0.0095
#: How deep one hand presses into the other: hands that cross are placed by their keys, and nothing
#: pushes them apart.
MUTUAL_DEEPEST = 0.014
#: Frames of each scene.
FRAMES = 10


def _sphere(cut: float = 2.0) -> tuple[Segments, np.ndarray]:
    """A sphere of 10 mm as a hand of one segment, open above `cut` radii."""
    from benchmarks.penetration import _cuts

    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.01)
    below = (ball.vertices[ball.faces][..., 2] < cut * 0.01).all(axis=1)
    skin = np.asarray(ball.faces[below])
    count = len(ball.vertices)
    parts = Segments(
        owner=np.zeros(count, dtype=np.int64),
        skin=(skin,),
        cuts=(_cuts(skin, count),),
        touching=np.ones((1, 1), dtype=bool),
        way=np.zeros((count, count)),
    )
    return parts, np.asarray(ball.vertices)


@pytest.mark.parametrize("cut", [2.0, 0.5])
def test_depth_in_a_sphere(cut: float) -> None:
    parts, vertices = _sphere(cut)
    assert len(parts.cuts[0]) == (1 if cut < 1.0 else 0)
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(200, 3))
    directions[:, 2] = -np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = rng.uniform(0.001, 0.014, 200)
    depth = mutual_penetration(radius[:, None] * directions, parts, vertices)
    # The facets lie within 0.05 mm of the sphere.
    np.testing.assert_allclose(depth, np.maximum(0.01 - radius, 0.0), atol=6e-5)
    above = np.array([[0.0, 0.0, 0.009]])
    assert (mutual_penetration(above, parts, vertices) > 0).all() == (cut > 1.0)


@pytest.fixture(scope="module")
def hand() -> SubjectHand:
    return scene_hands(load_scene("capture1"), MOVING)["right"]


def test_a_finger_pushed_into_another_is_found(hand: SubjectHand) -> None:
    # Oracle: the outer half of the index finger, moved onto the middle finger's, is inside it by
    # less than a finger's thickness; the hand at rest is nowhere inside itself.
    parts = segments(hand.template)
    vertices = hand.template.vertices.copy()
    assert self_penetration(parts, vertices).max() < 1e-3
    index, middle = (np.isin(parts.owner, joints) for joints in ((2, 3), (5, 6)))
    vertices[index] += vertices[middle].mean(axis=0) - vertices[index].mean(axis=0)
    depth = self_penetration(parts, vertices)
    assert 0.002 < depth[index].max() < 0.012


@pytest.mark.parametrize("name", sorted(gestures()))
def test_gestures_are_bounded(hand: SubjectHand, name: str) -> None:
    depth = hand_penetration(hand, moment_of_key(HandKey(name)), "right")
    assert depth.max() < GESTURE_DEEPEST


@pytest.mark.slow
@pytest.mark.parametrize("name", scene_names())
def test_frames_of_scenes_are_bounded(name: str) -> None:
    moments = (np.arange(FRAMES) + 0.5) / FRAMES
    for part, depths in scene_penetration(load_scene(name), moments).items():
        assert depths.max() < (MUTUAL_DEEPEST if part == "both" else SELF_DEEPEST)


INTERACTING = [name for name in scene_names() if load_scene(name).hands == "both"]
#: Deepest that one hand may press into the other, m.
TOUCH_DEEPEST = 0.012


def _distances(name: str, moment: float) -> tuple[float, float]:
    """How deep the left hand is inside the right one, and how near it is, m."""
    scene = load_scene(name)
    hands = scene_hands(scene, MOVING)
    parameters = RenderStage(scene, RenderCost()).parameters(
        hands_at(scene, moment * scene.duration)
    )
    right, normals = hands["right"].pose(*parameters["right"])
    left, _ = hands["left"].pose(*parameters["left"])
    # Farther away than 30 mm the nearest normal tells nothing; there the distance is infinite.
    distance, nearest = cKDTree(right).query(left, distance_upper_bound=0.03)
    near = np.flatnonzero(np.isfinite(distance))
    away = left[near] - right[nearest[near]]
    inside = near[np.einsum("ni,ni->n", away, normals[nearest[near]]) < 0]
    return float(distance[inside].max(initial=0.0)), float(distance.min())


@pytest.mark.slow
@pytest.mark.parametrize("name", INTERACTING)
def test_hands_do_not_run_through_each_other(name: str) -> None:
    rows = [_distances(name, frame / 60) for frame in range(0, 60, 2)]
    depth, gap = np.array(rows).T
    assert depth.max() < TOUCH_DEEPEST
    assert gap.min() < 0.004  # and they touch at times
