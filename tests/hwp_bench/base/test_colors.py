"""Colour: the oracle for sRGB is scikit-image-free arithmetic of IEC 61966-2-1 at known points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.base.colors import lamp_color, linear_to_srgb, srgb_to_linear


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
