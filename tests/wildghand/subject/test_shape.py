"""The shape of a person as an avatar keeps it. Oracles: the round trip, and the stated bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from hwp_bench.base.errors import BadInput
from hwp_bench.hands import load_template
from wildghand.subject import SubjectShape

RIGHT = load_template("anny", "right")


def a_shape() -> SubjectShape:
    rng = np.random.default_rng(0)
    vertices = 1e-3 * rng.normal(size=RIGHT.vertices.shape).astype(np.float32)
    joints = 1e-3 * rng.normal(size=RIGHT.joints.shape).astype(np.float32)
    return SubjectShape(vertices.astype(np.float64), joints.astype(np.float64))


def test_a_kept_shape_is_read_again_to_the_bit() -> None:
    shape = a_shape()
    read = SubjectShape.from_tensors(shape.to_tensors(), "model", V=len(RIGHT.vertices))
    assert read is not None
    np.testing.assert_array_equal(read.vertices, shape.vertices)
    np.testing.assert_array_equal(read.joints, shape.joints)
    assert SubjectShape.from_tensors({}, "model", V=len(RIGHT.vertices)) is None


def test_the_left_hand_is_the_mirror_image() -> None:
    shape, left = a_shape(), load_template("anny", "left")
    moved = shape.applied(left).vertices - left.vertices
    np.testing.assert_allclose(
        moved, (shape.applied(RIGHT).vertices - RIGHT.vertices) * [-1.0, 1.0, 1.0], atol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("vertices", lambda t: t[:-1]),
        ("joints", lambda t: t[None]),
        ("vertices", lambda t: torch.full_like(t, torch.nan)),
        ("joints", lambda t: t + 1.0),
        ("vertices", lambda t: t - torch.inf),
    ],
)
def test_what_is_no_shape_is_refused_by_name(
    name: str, damage: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    tensors = a_shape().to_tensors()
    tensors[f"subject_{name}"] = damage(tensors[f"subject_{name}"])
    with pytest.raises(BadInput, match=f"subject_{name}"):
        SubjectShape.from_tensors(tensors, "model.safetensors", V=len(RIGHT.vertices))


def test_a_part_that_is_missing_is_named() -> None:
    tensors = a_shape().to_tensors()
    del tensors["subject_joints"]
    with pytest.raises(BadInput, match="subject_joints"):
        SubjectShape.from_tensors(tensors, "model.safetensors", V=len(RIGHT.vertices))
