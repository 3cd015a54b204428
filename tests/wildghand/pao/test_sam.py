"""Segment Anything as regions and hands. Oracles: a stub network; the cache's own count."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_networks import write_sam_file, write_sam_folder

from hwp_bench.base.errors import BadInput
from wildghand.pao.segmenters import PromptedHand, RegionCache, SegmentAnything, mask_of, open_sam
from wildghand.sam import check_checkpoint

PICTURE = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)


class StubNetwork:
    """Sees the left half around points at the left, the right one around those at the right."""

    def __init__(self) -> None:
        self.seen = 0

    def see(self, image: np.ndarray) -> StubNetwork:
        self.seen += 1
        return self

    def masks_at(self, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        left = torch.where(torch.arange(48) < 24, 1.0, -1.0).expand(40, 48)
        masks = torch.stack([left if x < 24 else -left for x in places[:, 0]])
        return torch.stack([-masks, masks, -masks], dim=1), torch.tensor([[0.1, 0.9, 0.2]])

    def full(self, masks: torch.Tensor) -> torch.Tensor:
        return masks


def stub() -> tuple[SegmentAnything, list[StubNetwork]]:
    loaded: list[StubNetwork] = []

    def load() -> Any:
        loaded.append(StubNetwork())
        return loaded[-1]

    return SegmentAnything("x", load), loaded


def test_roots_prompt_the_best_mask_of_each_hand_once(tmp_path: Path) -> None:
    sam, loaded = stub()
    left = np.broadcast_to(np.arange(48) < 24, (40, 48))
    assert not loaded  # a fit whose masks are all kept needs no network
    cache = RegionCache(tmp_path)
    for _ in range(2):
        assert np.array_equal(
            mask_of(cache.regions(PICTURE, PromptedHand(sam, ((3.0, 4.0),)))), left
        )
    assert len(loaded) == 1
    assert loaded[0].seen == 1
    both = PromptedHand(sam, ((3.0, 4.0), (40.0, 4.0)))
    assert mask_of(cache.regions(PICTURE, both)).all()
    outside = PromptedHand(sam, ((48.0, 4.0), (float("nan"), 4.0)))
    assert not mask_of(cache.regions(PICTURE, outside)).any()
    assert loaded[0].seen == 2


@pytest.mark.parametrize("write", [write_sam_file, write_sam_folder])
def test_a_checkpoint_gives_regions_and_a_hand(tmp_path: Path, write: Any) -> None:
    path = write(tmp_path / "sam")
    check_checkpoint(path)
    sam = open_sam(path)
    regions = sam.regions(PICTURE)
    assert regions.labels.shape == (40, 48)
    assert regions.membership is not None
    mask = sam.hand(PICTURE, ((24.0, 20.0),))
    assert mask.shape == (40, 48)
    assert np.array_equal(mask, open_sam(path).hand(PICTURE, ((24.0, 20.0),)))
    assert open_sam(path).identity == sam.identity != open_sam(write(tmp_path / "b", 1)).identity


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="does not exist"):
        open_sam(tmp_path / "none.pth")
