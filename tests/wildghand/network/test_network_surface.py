"""Oracle: `mirror_template` and the anchors' own positions; 1e-6 m."""

from __future__ import annotations

import numpy as np
import torch

from hwp_bench.hands import (
    HandTemplate,
    SurfaceAnchors,
    anchor_positions,
    load_template,
    sample_surface,
)
from wildghand.network import mirrored_anchors, surface_points

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
