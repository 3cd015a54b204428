"""Superpixels. Oracles: connected components (scipy), drawn images with known edges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import label

from hwp_bench.base.errors import UsageError
from wildghand.pao.segmenters import Superpixels


def disc_image(height: int = 96, width: int = 96, seed: int = 0) -> np.ndarray:
    """A bright disc before a darker, noisy ground."""
    rows, columns = np.mgrid[:height, :width]
    disc = (rows - height / 2) ** 2 + (columns - width / 2) ** 2 < (height / 3) ** 2
    noise = np.random.default_rng(seed).normal(0.0, 4.0, (height, width, 3))
    return (
        (np.where(disc[..., None], (210, 160, 140), (60, 90, 70)) + noise)
        .clip(0, 255)
        .astype(np.uint8)
    )


def test_superpixels_are_connected_follow_edges_and_repeat() -> None:
    image = disc_image()
    regions = Superpixels(count=64).regions(image)
    assert 32 <= regions.count <= 128
    disc = image[..., 0] > 135
    mixed = 0
    for u in range(regions.count):
        inside = regions.labels == u
        assert label(inside)[1] == 1
        share = disc[inside].mean()
        mixed += min(share, 1.0 - share) * inside.sum()
    # Half of what a grid of the same size would mix.
    grid = np.arange(96)[:, None] // 12 * 8 + np.arange(96)[None] // 12
    blind = sum(
        min(disc[grid == u].mean(), 1.0 - disc[grid == u].mean()) * (grid == u).sum()
        for u in range(64)
    )
    assert mixed < 0.5 * blind
    assert np.array_equal(regions.labels, Superpixels(count=64).regions(image).labels)


@settings(max_examples=40, deadline=None)
@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    value=st.integers(0, 255),
    count=st.integers(1, 400),
)
def test_any_size_of_a_plain_picture_works(height: int, width: int, value: int, count: int) -> None:
    regions = Superpixels(count=count).regions(np.full((height, width, 3), value, np.uint8))
    assert regions.labels.shape == (height, width)
    assert regions.count >= 1


def test_identity_tells_settings_apart_and_bad_ones_are_named() -> None:
    assert Superpixels().identity == Superpixels().identity != Superpixels(count=249).identity
    for bad in ({"count": 0}, {"iterations": 0}, {"compactness": 0.0}):
        with pytest.raises(UsageError, match=next(iter(bad))):
            Superpixels(**bad)
    for image in (np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)):
        with pytest.raises(UsageError, match="image"):
            Superpixels().regions(image)
