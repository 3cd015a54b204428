"""The two-chart texture layout: no face turned over, one scale, halves kept apart."""

from __future__ import annotations

import numpy as np
import pytest

from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.hands.skeleton import palm_directions
from hwp_bench.hands.sources import two_chart_uv


@pytest.mark.parametrize("side", ["right", "left"])
def test_charts_of_a_mano_hand(mano_folder: str, side: str) -> None:
    check(load_template(f"mano:{mano_folder}", side=side), rebuilt=False)


@pytest.mark.parametrize("side", ["right", "left"])
def test_charts_of_the_free_hand(side: str) -> None:
    check(load_template(side=side), rebuilt=True)


def check(hand: HandTemplate, rebuilt: bool) -> None:
    uv, face_uv = hand.uv, hand.face_uv
    if rebuilt:
        uv, face_uv = two_chart_uv(hand.vertices, hand.faces, hand.joints, hand.side)
    assert uv.min() >= 0.0
    assert uv.max() <= 1.0
    corners = uv[face_uv]
    assert ((corners[..., 0] < 0.5).all(axis=1) | (corners[..., 0] > 0.5).all(axis=1)).all()
    a, b, c = np.moveaxis(corners, 1, 0)
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert areas.min() >= -1e-12
    # One scale: a chart's areas are those of the mesh seen from the palm, times one factor.
    points = hand.vertices[hand.faces]
    normals = 0.5 * np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    seen = np.abs(normals @ palm_directions(hand.joints, hand.side).palmar)
    factor = areas.sum() / seen.sum()
    np.testing.assert_allclose(areas, seen * factor, atol=1e-9)
    # The palm is on the right, and its faces look out of it.
    towards = normals @ palm_directions(hand.joints, hand.side).palmar
    on_right = corners[:, 0, 0] > 0.5
    assert (towards[on_right] >= 0.0).all()
    assert (towards[~on_right] <= 0.0).all()
