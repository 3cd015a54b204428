"""Regions of pictures, kept on disk by content: computed once for each frame, ever."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import numpy as np

from hwp_bench.base.arrays import read_npz, take, write_npz
from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import cache_root, sha256_json
from hwp_bench.base.images import pixel_digest
from wildghand.pao.regions.frame_regions import FrameRegions

#: Bytes that the cached regions may take; those of a frame take some 10 kB.
MAX_CACHE_BYTES = 512 * 1024 * 1024
#: Largest file that is read, unpacked, bytes: 4K labels and their membership.
_MAX_FILE_BYTES = 64 * 1024 * 1024


class Segmenter(Protocol):
    """What cuts pictures into regions."""

    @property
    def identity(self) -> str:
        """Digest of everything that the regions of a picture depend on."""

    def regions(self, picture: np.ndarray) -> FrameRegions:
        """Cut an (H, W, 3) uint8 sRGB picture."""


class RegionCache:
    """Regions by picture and segmenter.

    A damaged file counts as absent. A folder that cannot be written to means that nothing is
    kept, no error.

    Args:
        folder: where the files are; by default in the toolkit's cache folder.
        max_bytes: of all files; `prune` removes those that were used longest ago.
    """

    def __init__(self, folder: Path | None = None, max_bytes: int = MAX_CACHE_BYTES) -> None:
        self.folder = cache_root() / "wildghand" / "regions" if folder is None else folder
        self.max_bytes = max_bytes

    def regions(self, picture: np.ndarray, segmenter: Segmenter) -> FrameRegions:
        """Regions of one picture, from the disk or made now.

        Args:
            picture: (H, W, 3) uint8 sRGB.
            segmenter: makes them.
        """
        path = self.folder / f"{sha256_json([pixel_digest(picture), segmenter.identity])}.npz"
        kept = _load(path, picture.shape[:2])
        if kept is not None:
            return kept
        made = segmenter.regions(picture)
        with contextlib.suppress(HwpError):
            _store(path, made)
        return made

    def clip(self, pictures: Iterable[np.ndarray], segmenter: Segmenter) -> list[FrameRegions]:
        """Regions of every picture of a clip; the cache is pruned at the end."""
        made = [self.regions(picture, segmenter) for picture in pictures]
        self.prune()
        return made

    def prune(self) -> None:
        """Remove the files that were used longest ago until the rest fits."""
        entries = []
        with contextlib.suppress(OSError):
            for entry in os.scandir(self.folder):
                # Another process may remove what this one has just listed.
                with contextlib.suppress(OSError):
                    if entry.name.endswith(".npz"):
                        status = entry.stat(follow_symlinks=False)
                        entries.append((status.st_mtime_ns, status.st_size, entry.path))
        total = sum(size for _, size, _ in entries)
        for _, size, path in sorted(entries):
            if total <= self.max_bytes:
                return
            with contextlib.suppress(OSError):
                os.unlink(path)
            total -= size


def _load(path: Path, shape: tuple[int, int]) -> FrameRegions | None:
    if not path.is_file():
        return None
    try:
        arrays = read_npz(path, max_bytes=_MAX_FILE_BYTES)
        labels = take(arrays, "labels", shape, where=path, dtype=np.uint16)
        membership = None
        if "membership" in arrays:
            membership = take(arrays, "membership", (None, None), where=path, dtype=bool)
            if labels.size and labels.max() >= len(membership):
                raise BadInput("has fewer rows than labels", where=path, field="membership")
    except BadInput:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return FrameRegions(labels, membership)


def _store(path: Path, regions: FrameRegions) -> None:
    arrays = {"labels": regions.labels}
    if regions.membership is not None:
        arrays["membership"] = regions.membership
    write_npz(path, arrays)
