"""Compiled sums and harmonics; oracle: torch's `embedding_bag` and `sh_basis`; float32, 1e-6."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildghand.gaussians.regularizers import sum_bags
from wildghand.gaussians.shading import fill_harmonics, sh_basis, sh_count


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.integers(0, 5), min_size=1, max_size=1_200),
    rows=st.integers(1, 40),
    channels=st.integers(1, 40),
    seed=st.integers(0, 99),
)
def test_sums_are_those_of_embedding_bag(
    lengths: list[int], rows: int, channels: int, seed: int
) -> None:
    random = torch.Generator().manual_seed(seed)
    start = torch.tensor([0, *lengths[:-1]]).cumsum(0)
    index = torch.randint(0, rows, (sum(lengths),), generator=random)
    weight = torch.randn(len(index), generator=random)
    values = torch.randn(rows, channels, generator=random)
    made = sum_bags(values, index, weight, start)
    expected = torch.nn.functional.embedding_bag(
        index, values, start, mode="sum", per_sample_weights=weight
    )
    torch.testing.assert_close(made, expected, rtol=1e-5, atol=1e-6)


def test_rows_of_a_slice_are_read_where_they_lie() -> None:
    wide = torch.arange(24.0).reshape(4, 6)
    ones, rows = torch.ones(4), torch.arange(4)
    assert torch.equal(sum_bags(wide[:, 2:4], rows, ones, rows), wide[:, 2:4])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_are_those_of_sh_basis(degree: int) -> None:
    random = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(1_500, 3, generator=random), dim=-1)
    out = torch.full((1_500, 3 + sh_count(degree)), 7.0)
    fill_harmonics(normals, degree, out, 2)
    expected = sh_basis(normals.double(), degree)[:, 1:].float()
    torch.testing.assert_close(out[:, 2:-2], expected, rtol=1e-5, atol=1e-6)
    assert (out[:, :2] == 7.0).all()
    assert (out[:, -2:] == 7.0).all()
