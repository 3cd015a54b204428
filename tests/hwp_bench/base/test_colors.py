"""Colour: the oracle for sRGB is scikit-image-free arithmetic of IEC 61966-2-1 at known points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.base.colors import COUNT, harmonics, lamp_color, linear_to_srgb, srgb_to_linear


@pytest.mark.parametrize(
    ("srgb", "linear"), [(0.0, 0.0), (0.5, 0.2140411), (0.04045, 0.0031308), (1.0, 1.0)]
)
def test_known_points(srgb: float, linear: float) -> None:
    assert float(srgb_to_linear(np.array(srgb))) == pytest.approx(linear, abs=1e-6)


@given(st.floats(0.0, 1.0))
def test_decoding_undoes_encoding(value: float) -> None:
    back = srgb_to_linear(linear_to_srgb(np.array(value)))
    assert float(back) == pytest.approx(value, abs=2e-6)


@given(st.floats(1500.0, 15000.0))
def test_lamps_have_luminance_one(kelvin: float) -> None:
    color = lamp_color(kelvin)
    assert float(color @ [0.2126, 0.7152, 0.0722]) == pytest.approx(1.0)


def test_low_temperatures_are_red() -> None:
    warm, cold = lamp_color(2800.0), lamp_color(9000.0)
    assert warm[0] > warm[2]
    assert cold[2] > cold[0]


def test_pixels_without_a_normal_get_the_constant_alone() -> None:
    flat = harmonics(np.zeros((2, 3)))
    assert flat[0].tolist() == [1.0, *[0.0] * 8]
    unit = np.array([0.0, 0.0, 1.0])
    assert harmonics(unit)[-1] == pytest.approx(2.0)


def test_they_are_orthogonal_over_the_sphere() -> None:
    # A Fibonacci lattice of 20,000 points integrates polynomials of degree 4 to about 1e-4.
    count = 20_000
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - height**2)
    points = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)
    values = harmonics(points)
    assert values.shape == (count, COUNT)
    products = values.T @ values / count
    np.testing.assert_allclose(products - np.diag(np.diag(products)), 0.0, atol=1e-3)
    assert (np.diag(products) > 0.05).all()
