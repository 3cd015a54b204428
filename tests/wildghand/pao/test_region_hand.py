"""The hand's mask. Oracle: a drawn hand whose true mask is known."""

from __future__ import annotations

import numpy as np
import pytest

from hwp_bench.base.errors import ShapeMismatch
from wildghand.pao.segmenters import graph_cut_hands


def drawn(shift: int, size: int = 96) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Picture, visible skin, and the silhouette that a pose off by 2 px would project.

    A green thing covers a part of the hand and can be seen beside it.
    """
    rows, columns = np.mgrid[:size, :size]
    whole = (rows - 48) ** 2 + (columns - 40 - shift) ** 2 < 26**2
    covered = (columns > 48 + shift) & (rows < 40)
    skin = whole & ~covered
    noise = np.random.default_rng(shift).normal(0.0, 3.0, (size, size, 3))
    colour = np.where(skin[..., None], (205, 150, 125), (50, 80, 95))
    colour = np.where(covered[..., None], (40, 160, 60), colour)
    image = (colour + noise).clip(0, 255).astype(np.uint8)
    return image, skin, np.roll(whole, 2, axis=1)


def test_graph_cut_finds_the_visible_hand() -> None:
    clip = [drawn(shift) for shift in (0, 4, 8)]
    masks = list(graph_cut_hands([c[0] for c in clip], [c[2] for c in clip]))
    for (_, skin, silhouette), mask in zip(clip, masks, strict=True):
        overlap = (mask & skin).sum() / (mask | skin).sum()
        prompt = (silhouette & skin).sum() / (silhouette | skin).sum()
        assert overlap > 0.93 > prompt


def test_no_hand_no_mask() -> None:
    image, _, silhouette = drawn(0)
    masks = list(graph_cut_hands([image] * 2, [np.zeros_like(silhouette)] * 2))
    assert not any(mask.any() for mask in masks)
    assert list(graph_cut_hands([], [])) == []
    with pytest.raises(ShapeMismatch, match="silhouettes"):
        list(graph_cut_hands([image], [silhouette[1:]]))
