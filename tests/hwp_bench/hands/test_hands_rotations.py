"""Rotations against scipy's Rotation (float64: 1e-14, float32: 1e-6) and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from hwp_bench.hands.articulation import axis_angle_to_matrix, matrix_to_axis_angle, right_jacobian

LENGTHS = (0.0, 1e-300, 1e-20, 1e-8, 1e-4, 0.0999, 0.1, 0.1001, 1.0, 3.0, np.pi, 6.0, 50.0)


def vectors_of(lengths: tuple[float, ...], seed: int = 1) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(len(lengths), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.array(lengths)[:, None]


def test_matrices_agree_with_scipy_at_every_length() -> None:
    vectors = vectors_of(LENGTHS)
    ours = axis_angle_to_matrix(torch.from_numpy(vectors)).numpy()
    np.testing.assert_allclose(ours, Rotation.from_rotvec(vectors).as_matrix(), atol=2e-14)


@given(st.lists(st.floats(-7.0, 7.0, width=32), min_size=3, max_size=3))
def test_float32_matrices_agree_with_scipy(vector: list[float]) -> None:
    ours = axis_angle_to_matrix(torch.tensor(vector, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(ours, Rotation.from_rotvec(vector).as_matrix(), atol=2e-6)


@pytest.mark.parametrize("length", [0.0, 1e-5, 0.0999, 0.1001, 1.0, 3.1, 7.0])
def test_gradients_agree_with_finite_differences(length: float) -> None:
    vector = torch.from_numpy(vectors_of((length,))).requires_grad_()
    assert torch.autograd.gradcheck(axis_angle_to_matrix, (vector,))
    assert torch.autograd.gradgradcheck(axis_angle_to_matrix, (vector,))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_is_finite_at_every_length(dtype: torch.dtype) -> None:
    vectors = torch.from_numpy(vectors_of(LENGTHS)).to(dtype).requires_grad_()
    axis_angle_to_matrix(vectors).sum().backward()
    assert vectors.grad is not None
    assert torch.isfinite(vectors.grad).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype) -> None:
    vectors = torch.from_numpy(vectors_of((0.0, 0.05, 1.0, 40.0, 300.0))).to(dtype)
    ours = axis_angle_to_matrix(vectors)
    assert ours.dtype == dtype
    expected = Rotation.from_rotvec(vectors.double().numpy()).as_matrix()
    # Rounding to the type; the angle itself is off by 300 ulp of float32.
    np.testing.assert_allclose(
        ours.double(), expected, atol=0.5 * torch.finfo(dtype).eps + 300 * 2.0**-23
    )


@pytest.mark.parametrize(("dtype", "limit"), [(torch.float32, 4.2e9), (torch.float64, 1.1e77)])
def test_only_the_axis_of_a_huge_vector_matters(dtype: torch.dtype, limit: float) -> None:
    axes = torch.from_numpy(vectors_of((1.0,) * 4, 6)).to(dtype)
    axes = axes / axes.abs().amax(dim=-1, keepdim=True)
    first, second = (axis_angle_to_matrix(axes * limit * share) for share in (1e3, 1e9))
    turned = torch.einsum("nij,nj->ni", first, axes)
    tolerance = 32 * torch.finfo(dtype).eps
    np.testing.assert_allclose(turned, axes, atol=tolerance)
    np.testing.assert_allclose(torch.linalg.det(second), 1.0, atol=tolerance)


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-3, 0.19, 0.21, 1.0, 2.5, 3.1415])
def test_vectors_come_back_from_matrices(length: float) -> None:
    vectors = torch.from_numpy(np.concatenate([vectors_of((length,), seed) for seed in range(20)]))
    back = matrix_to_axis_angle(axis_angle_to_matrix(vectors))
    np.testing.assert_allclose(back, vectors, atol=1e-12)


def test_half_turns_give_an_axis_of_length_pi() -> None:
    matrices = torch.from_numpy(Rotation.from_rotvec(vectors_of((np.pi,) * 30, 3)).as_matrix())
    vectors = matrix_to_axis_angle(matrices)
    np.testing.assert_allclose(vectors.norm(dim=1), np.pi, atol=1e-9)
    np.testing.assert_allclose(axis_angle_to_matrix(vectors), matrices, atol=1e-9)


@pytest.mark.parametrize("length", [0.0, 0.05, 1.0, 2.9])
def test_inverse_gradients_agree_with_finite_differences(length: float) -> None:
    vector = torch.from_numpy(vectors_of((length,), 4)).requires_grad_()
    # Through both maps, so that the differences stay on the rotation group.
    assert torch.autograd.gradcheck(
        lambda v: matrix_to_axis_angle(axis_angle_to_matrix(v)), (vector,)
    )


@settings(max_examples=30, deadline=None)
@given(arrays(float, 3, elements=st.floats(-2.5, 2.5)), arrays(float, 3, elements=st.floats(-1, 1)))
def test_rates_of_rotations_are_those_of_scipy(vector: np.ndarray, direction: np.ndarray) -> None:
    # Central differences of 1e-5: 1e-8.
    step = 1e-5 * direction
    turn = Rotation.from_rotvec(vector - step).inv() * Rotation.from_rotvec(vector + step)
    np.testing.assert_allclose(
        right_jacobian(vector) @ direction, turn.as_rotvec() / 2e-5, atol=1e-7
    )
