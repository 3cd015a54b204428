"""Regions. Oracle: sums and images made mask by mask in numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.pao.regions import overlapping, partition, stack_regions


@settings(max_examples=80, deadline=None)
@given(
    masks=hnp.arrays(
        bool, st.tuples(st.integers(0, 12), st.integers(1, 6), st.integers(1, 7)), fill=st.nothing()
    ),
    seed=st.integers(0, 99),
)
def test_unions_of_atoms_are_the_masks(masks: np.ndarray, seed: int) -> None:
    regions = stack_regions([overlapping(masks)])
    random = np.random.default_rng(seed)
    values = random.normal(size=masks.shape[1:])
    sums = regions.sums(torch.from_numpy(values)[None])
    np.testing.assert_allclose(sums[0], (masks * values).sum(axis=(1, 2)), atol=1e-12)
    weights = random.normal(size=len(masks))
    spread = regions.spread(torch.from_numpy(weights)[None])
    np.testing.assert_allclose(spread[0], (masks * weights[:, None, None]).sum(axis=0), atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(
    labels=hnp.arrays(
        np.int64, st.tuples(st.integers(1, 6), st.integers(1, 7)), elements=st.integers(-5, 300)
    )
)
def test_a_partition_keeps_its_labels_apart(labels: np.ndarray) -> None:
    regions = partition(labels)
    assert regions.count == len(np.unique(labels))
    pairs = set(zip(labels.ravel().tolist(), regions.labels.ravel().tolist(), strict=True))
    assert len(pairs) == regions.count


def test_frames_do_not_mix_whatever_regions_they_have() -> None:
    first = partition(np.array([[0, 1], [1, 2]]))
    second = overlapping(np.array([[[True, True], [False, False]], [[True, False], [True, False]]]))
    regions = stack_regions([first, second])
    values = torch.tensor([[[1.0, 2.0], [4.0, 8.0]], [[1.0, 2.0], [4.0, 8.0]]])
    sums = regions.sums(values)
    assert sums[0, :3].tolist() == [1.0, 6.0, 8.0]
    assert sums[1, :2].tolist() == [3.0, 5.0]
    assert (sums[1, 2:] == 0.0).all()
    assert regions.spread(torch.eye(2, regions.count))[1].tolist() == [[1.0, 0.0], [1.0, 0.0]]


def test_bad_regions_are_named() -> None:
    with pytest.raises(UsageError, match="labels"):
        partition(np.zeros((3, 3)))
    with pytest.raises(UsageError, match="65536"):
        partition(np.arange(300 * 300).reshape(300, 300))
    with pytest.raises(UsageError, match="masks"):
        overlapping(np.zeros((3, 3), bool))
    with pytest.raises(ShapeMismatch):
        stack_regions([partition(np.zeros((2, 2), int)), partition(np.zeros((2, 3), int))])
    with pytest.raises(ShapeMismatch):
        stack_regions([])
