"""The cache of regions. Oracle: a segmenter that counts how often it is asked."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from wildghand.pao.regions import FrameRegions, overlapping, partition
from wildghand.pao.segmenters import RegionCache


class Counting:
    """Gives regions that differ between images."""

    def __init__(self, overlap: bool = False, identity: str = "a") -> None:
        self.asked = 0
        self.overlap = overlap
        self.identity = identity

    def regions(self, image: np.ndarray) -> FrameRegions:
        self.asked += 1
        bright = image[..., 0] > 127
        if self.overlap:
            return overlapping(np.stack([bright, ~bright, np.ones_like(bright)]))
        return partition(bright.astype(int))


def images(count: int = 3) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [random.integers(0, 256, (9, 7, 3), dtype=np.uint8) for _ in range(count)]


@pytest.mark.parametrize("overlap", [False, True])
def test_regions_are_made_once_for_each_content(tmp_path: Path, overlap: bool) -> None:
    segmenter = Counting(overlap)
    made = RegionCache(tmp_path).clip(images(), segmenter)
    again = RegionCache(tmp_path).clip(images(), segmenter)
    assert segmenter.asked == 3
    for first, second in zip(made, again, strict=True):
        assert np.array_equal(first.labels, second.labels)
        assert first.count == second.count
        assert (first.membership is None) == (second.membership is None)
        if overlap:
            assert np.array_equal(first.membership, second.membership)
    RegionCache(tmp_path).regions(images()[0], Counting(identity="b"))
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04", b"no archive"])
def test_a_damaged_file_is_made_again(tmp_path: Path, damage: bytes) -> None:
    segmenter = Counting()
    cache = RegionCache(tmp_path)
    made = cache.regions(images()[0], segmenter)
    next(tmp_path.iterdir()).write_bytes(damage)
    again = cache.regions(images()[0], segmenter)
    assert segmenter.asked == 2
    assert np.array_equal(made.labels, again.labels)


def test_a_forged_file_is_made_again(tmp_path: Path) -> None:
    segmenter = Counting(overlap=True)
    cache = RegionCache(tmp_path)
    cache.regions(images()[0], segmenter)
    path = next(tmp_path.iterdir())
    forged = [
        {"labels": np.full((9, 7), 9, np.uint16), "membership": np.ones((2, 3), bool)},
        {"labels": np.zeros((9, 8), np.uint16)},
        {"other": np.zeros(3)},
    ]
    for arrays in forged:
        np.savez(path, **arrays)
        assert cache.regions(images()[0], segmenter).count == 3
    assert segmenter.asked == 4


def test_the_oldest_files_go_first(tmp_path: Path) -> None:
    segmenter = Counting()
    cache = RegionCache(tmp_path)
    for age, image in enumerate(images()):
        cache.regions(image, segmenter)
        for path in tmp_path.iterdir():
            if path.stat().st_mtime > 1e6:
                os.utime(path, (100 + age, 100 + age))
    size = max(path.stat().st_size for path in tmp_path.iterdir())
    cache.regions(images()[0], segmenter)
    RegionCache(tmp_path, max_bytes=2 * size).prune()
    assert segmenter.asked == 3
    assert len(list(tmp_path.iterdir())) == 2
    cache.regions(images()[0], segmenter)
    assert segmenter.asked == 3
    cache.regions(images()[1], segmenter)
    assert segmenter.asked == 4


def test_nothing_is_kept_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    segmenter = Counting()
    made = RegionCache(tmp_path / "file" / "folder").clip(images(), segmenter)
    assert segmenter.asked == len(made) == 3


def test_the_default_folder_is_in_the_toolkits_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HWP_CACHE", str(tmp_path))
    RegionCache().regions(images()[0], Counting())
    assert len(list((tmp_path / "wildghand" / "regions").iterdir())) == 1
