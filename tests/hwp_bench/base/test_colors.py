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


def _black_body(kelvin: float) -> np.ndarray:
    """Linear sRGB of a black body, relative to green and to 5500 K.

    Source: Planck's law; the colour matching functions by the lobes of Wyman, Sloan and Shirley,
    "Simple Analytic Approximations to the CIE XYZ Color Matching Functions" (JCGT 2013); the
    matrix of IEC 61966-2-1.
    """
    nm = np.arange(380.0, 781.0)

    def lobe(height: float, middle: float, below: float, above: float) -> np.ndarray:
        return height * np.exp(-0.5 * ((nm - middle) / np.where(nm < middle, below, above)) ** 2)

    x = lobe(1.056, 599.8, 37.9, 31.0) + lobe(0.362, 442.0, 16.0, 26.7)
    x += lobe(-0.065, 501.1, 20.4, 26.2)
    y = lobe(0.821, 568.8, 46.9, 40.5) + lobe(0.286, 530.9, 16.3, 31.1)
    z = lobe(1.217, 437.0, 11.8, 36.0) + lobe(0.681, 459.0, 26.0, 13.8)
    matrix = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.204, 1.057]]
    light = [nm**-5.0 / np.expm1(1.438776877e7 / (nm * value)) for value in (kelvin, 5500.0)]
    shown, white = (matrix @ (np.stack([x, y, z]) @ power) for power in light)
    return np.asarray(shown / white / (shown / white)[1])


def _lamp(kelvin: float) -> np.ndarray:
    color = lamp_color(kelvin)
    return color / color[1]


@pytest.mark.parametrize("kelvin", [4600.0, 5000.0, 6500.0, 8000.0, 10_000.0, 12_000.0])
def test_lamps_are_black_bodies(kelvin: float) -> None:
    np.testing.assert_allclose(_lamp(kelvin), _black_body(kelvin), rtol=0.1)


def test_a_warm_lamp_is_less_warm_than_a_black_body() -> None:
    np.testing.assert_allclose(_lamp(3000.0), _black_body(3800.0), rtol=0.1)
    red, _, blue = _lamp(3000.0) / _black_body(3000.0)
    assert red < 0.85
    assert blue > 1.7


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
