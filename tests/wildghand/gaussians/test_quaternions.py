"""Oracle: scipy's Rotation, float64; tolerance 1e-12 unless a test says otherwise."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wildghand.gaussians.quaternions import (
    matrix_to_quat,
    quat_multiply,
    quat_rotate,
    quat_third_axis,
)

_ANGLES = st.tuples(*[st.floats(-7.0, 7.0)] * 3).map(np.array)


def to_quat(rotation: Rotation) -> torch.Tensor:
    return torch.from_numpy(rotation.as_quat()[..., [3, 0, 1, 2]])


@given(_ANGLES, _ANGLES)
def test_product_is_one_rotation_after_the_other(first: np.ndarray, second: np.ndarray) -> None:
    a, b = Rotation.from_rotvec(first), Rotation.from_rotvec(second)
    product = quat_multiply(to_quat(a), to_quat(b))
    expected = to_quat(a * b)
    assert abs(float((product * expected).sum())) > 1.0 - 1e-12


@given(_ANGLES, _ANGLES)
def test_rotation_of_a_vector(turn: np.ndarray, vector: np.ndarray) -> None:
    rotation = Rotation.from_rotvec(turn)
    rotated = quat_rotate(to_quat(rotation), torch.from_numpy(vector))
    np.testing.assert_allclose(rotated.numpy(), rotation.apply(vector), atol=1e-12)


@given(_ANGLES)
def test_third_axis_is_the_third_column(turn: np.ndarray) -> None:
    rotation = Rotation.from_rotvec(turn)
    axis = quat_third_axis(to_quat(rotation))
    np.testing.assert_allclose(axis.numpy(), rotation.as_matrix()[:, 2], atol=1e-12)


@given(_ANGLES)
def test_matrix_and_back(turn: np.ndarray) -> None:
    rotation = Rotation.from_rotvec(turn)
    quat = matrix_to_quat(torch.from_numpy(rotation.as_matrix()))
    assert abs(float((quat * to_quat(rotation)).sum())) > 1.0 - 1e-12


def test_half_turns_where_the_trace_formula_fails() -> None:
    turns = np.pi * np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.0, 0.8]]])
    rotations = Rotation.from_rotvec(turns)
    quats = matrix_to_quat(torch.from_numpy(rotations.as_matrix()))
    assert torch.isfinite(quats).all()
    # Near a half turn the entries of a matrix say the axis to about the root of the precision.
    np.testing.assert_allclose((quats * to_quat(rotations)).sum(-1).abs(), 1.0, atol=1e-7)
