"""Oracle: `mirror_template` and the anchors' own positions; 1e-6 m."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from hwp_bench.base.errors import BadInput, ShapeMismatch
from hwp_bench.hands import (
    HandTemplate,
    SurfaceAnchors,
    anchor_positions,
    load_template,
    sample_surface,
)
from wildghand.network import SurfacePoints, mirrored_anchors, surface_points

COLOR = torch.tensor([0.6, 0.45, 0.4])


def test_mirrored_anchors_are_the_same_points_of_the_other_hand() -> None:
    right, left = load_template("anny", "right"), load_template("anny", "left")
    anchors = sample_surface(right, 500, seed=3)
    mirrored = mirrored_anchors(anchors)

    def place(template: HandTemplate, anchors: SurfaceAnchors) -> np.ndarray:
        vertices = torch.from_numpy(template.vertices)
        return anchor_positions(vertices, torch.from_numpy(template.faces), anchors).numpy()

    np.testing.assert_allclose(
        place(left, mirrored), place(right, anchors) * [-1.0, 1.0, 1.0], atol=1e-12
    )
    a = surface_points(right, anchors, 1e-3, COLOR)
    b = surface_points(left, mirrored.to_torch(), 1e-3, COLOR)
    torch.testing.assert_close(b.uv, a.uv, rtol=0, atol=1e-6)
    torch.testing.assert_close(b.positions, a.positions, rtol=0, atol=1e-5)
    # Anchors that are sampled on the other hand lie elsewhere: the reason for the function.
    apart = place(left, sample_surface(left, 500, seed=3)) - place(left, mirrored)
    assert np.linalg.norm(apart, axis=1).mean() > 1e-3


def test_positions_fill_the_unit_box() -> None:
    template = load_template()
    points = surface_points(template, sample_surface(template, 3000), 1e-3, COLOR)
    assert points.positions.abs().max() <= 1.0
    assert points.positions.abs().amax(dim=0).min() > 0.9


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"uv": torch.zeros(3, 3)}, ShapeMismatch),
        ({"positions": torch.zeros(2, 3)}, ShapeMismatch),
        ({"uv": torch.zeros(0, 2), "positions": torch.zeros(0, 3)}, ShapeMismatch),
        ({"color": torch.tensor([0.1, float("nan"), 0.1])}, BadInput),
        ({"spacing": 0.0}, BadInput),
        ({"spacing": float("inf")}, BadInput),
    ],
)
def test_bad_surfaces_are_refused(changes: dict[str, Any], error: type[Exception]) -> None:
    good: dict[str, Any] = {
        "uv": torch.zeros(3, 2),
        "positions": torch.zeros(3, 3),
        "spacing": 1e-3,
    }
    with pytest.raises(error, match="|".join(changes)):
        SurfacePoints(**{**good, "color": COLOR, **changes})
