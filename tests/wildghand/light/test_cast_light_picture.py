"""The picture of a light. Oracle: lights whose shading and shadows are known."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.cast_light import lamps_of, rows_of, white_hands
from hwp_bench.capture import Capture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.light import CastLight
from wildghand.light.light import ring_around, spread_directions


def a_light(strength: float) -> CastLight:
    """Two lamps, of which the second has twice the strength of the first, and a weak sky."""
    lamps = np.array([[0.0, -0.96, -0.28], [0.96, 0.0, -0.28]])
    cones = [np.concatenate([lamp[None], ring_around(lamp, 0.1)]) for lamp in lamps]
    directions = np.concatenate([*cones, spread_directions(48)]).astype(np.float32)
    parts = np.repeat([strength, 2.0 * strength, 0.0], [7, 7, 48]).astype(np.float32) / 7.0
    return CastLight(directions, parts, 1.0)


def test_lamps_are_named_from_the_strongest_on() -> None:
    (first, share), (second, less) = lamps_of(a_light(0.5))
    np.testing.assert_allclose(first, [0.96, 0.0, -0.28], atol=1e-6)
    np.testing.assert_allclose(second, [0.0, -0.96, -0.28], atol=1e-6)
    assert (share, less) == (pytest.approx(0.4), pytest.approx(0.2))


def test_white_hands_show_shading_and_shadow_apart(
    tiny_avatar: WildGHandAvatar, make_painted: Callable[..., Capture]
) -> None:
    capture, avatar = make_painted(), copy.copy(tiny_avatar)
    avatar.model = copy.deepcopy(tiny_avatar.model)
    # Light from everywhere: everything is as bright, and nothing is in shadow.
    avatar.model.keep(a_light(0.0))
    shading, both, shadow = white_hands(avatar, capture, 3)
    np.testing.assert_allclose(shading, both, atol=1e-6)
    np.testing.assert_allclose(shadow, both, atol=1e-6)
    assert shading.max() == pytest.approx(0.6, abs=0.02)
    # Lamps from the side: what faces the camera has shadows.
    avatar.model.keep(a_light(0.2))
    shading, both, shadow = white_hands(avatar, capture, 3)
    assert (both <= shading + 1e-6).all()
    assert np.abs(shading - both).max() > 0.01
    picture = rows_of(avatar, capture, [1, 3])
    assert picture.ndim == 3
    assert picture.dtype == np.uint8
