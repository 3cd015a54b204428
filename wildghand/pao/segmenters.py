"""Regions and hands without a network: superpixels, kept on disk for each image, and graph cuts."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from hwp_bench.base.arrays import read_npz, take, write_npz
from hwp_bench.base.errors import BadInput, HwpError, ShapeMismatch, UsageError
from hwp_bench.base.files import cache_root, sha256_json
from hwp_bench.base.folders import trim
from hwp_bench.base.images import pixel_digest
from wildghand.pao.regions import FrameRegions, partition

#: Bytes that the cached regions may take; those of a frame take some 10 kB.
MAX_CACHE_BYTES = 512 * 1024 * 1024
#: Largest file that is read, unpacked, bytes: 4K labels and their membership.
_MAX_FILE_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True)
class Superpixels:
    """SLIC superpixels of an image: small areas of like colour that follow edges."""

    #: Superpixels that are aimed at.
    count: int = 250
    #: Compactness against colour, in 8-bit CIELAB levels over the edge of a superpixel.
    compactness: float = 10.0
    #: Rounds of the clustering.
    iterations: int = 10

    def __post_init__(self) -> None:
        for name in ("count", "iterations"):
            if getattr(self, name) < 1:
                raise UsageError(f"is {getattr(self, name)}", field=name, remedy="Use 1 or more.")
        if not (math.isfinite(self.compactness) and self.compactness > 0.0):
            raise UsageError(f"is {self.compactness}", field="compactness", remedy="Use 10.")

    @property
    def identity(self) -> str:
        """Digest of everything that the regions of an image depend on."""
        import cv2

        return sha256_json(["slic-1", cv2.__version__, asdict(self)])

    def regions(self, image: np.ndarray) -> FrameRegions:
        """Cut an image into superpixels; the same image gives the same ones.

        Args:
            image: (H, W, 3) uint8 sRGB.

        Returns:
            A partition; at least one region, about `count`.

        Raises:
            UsageError: not such an image, or an empty one.

        Source: Achanta et al., "SLIC superpixels compared to state-of-the-art superpixel
        methods"; OpenCV's implementation, small pieces joined to their neighbours.
        """
        import cv2

        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise UsageError(f"is {image.dtype} of shape {image.shape}", field="image")
        height, width = image.shape[:2]
        if height * width == 0:
            raise UsageError("has no pixel", field="image")
        edge = max(1, round(math.sqrt(height * width / self.count)))
        lab = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2Lab)
        # An image narrower than a superpixel makes OpenCV read beyond its end.
        below, right = max(0, 2 * edge - height), max(0, 2 * edge - width)
        lab = cv2.copyMakeBorder(lab, 0, below, 0, right, cv2.BORDER_REPLICATE)
        slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLIC, edge, self.compactness)
        slic.iterate(self.iterations)
        slic.enforceLabelConnectivity()
        return partition(slic.getLabels()[:height, :width])


class Segmenter(Protocol):
    """A way to cut images into regions."""

    @property
    def identity(self) -> str:
        """Digest of everything that the regions of an image depend on."""

    def regions(self, image: np.ndarray) -> FrameRegions:
        """Cut an (H, W, 3) uint8 sRGB image."""


class RegionCache:
    """Regions by image and segmenter.

    A damaged file counts as absent. A folder that cannot be written to means that nothing is
    kept, no error.

    Args:
        folder: where the files are; by default in the toolkit's cache folder.
        max_bytes: of all files; `prune` removes those that were used longest ago.
    """

    def __init__(self, folder: Path | None = None, max_bytes: int = MAX_CACHE_BYTES) -> None:
        self.folder = cache_root() / "wildghand" / "regions" if folder is None else folder
        self.max_bytes = max_bytes

    def regions(self, image: np.ndarray, segmenter: Segmenter) -> FrameRegions:
        """Regions of one image, from the disk or made now.

        Args:
            image: (H, W, 3) uint8 sRGB.
        """
        path = self.folder / f"{sha256_json([pixel_digest(image), segmenter.identity])}.npz"
        kept = _load(path, image.shape[:2])
        if kept is not None:
            return kept
        made = segmenter.regions(image)
        with contextlib.suppress(HwpError):
            _store(path, made)
        return made

    def clip(self, images: Iterable[np.ndarray], segmenter: Segmenter) -> list[FrameRegions]:
        """Regions of every image of a clip; the cache is pruned at the end."""
        made = [self.regions(image, segmenter) for image in images]
        self.prune()
        return made

    def prune(self) -> None:
        """Remove the files that were used longest ago until the rest fits."""
        trim(self.folder, ".npz", self.max_bytes)


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


def graph_cut_hands(
    images: Sequence[np.ndarray], silhouettes: Sequence[np.ndarray]
) -> Iterator[np.ndarray]:
    """y_h of raw frames: graph cuts prompted by the projected hand, one colour model for all.

    Args:
        images: (H, W, 3) uint8 sRGB each.
        silhouettes: (H, W) bool each, where the posed hand would be seen if nothing covered it;
            where it is empty, so is the mask.

    Yields:
        (H, W) bool for each frame.

    Raises:
        ShapeMismatch: a silhouette that does not belong to its image.

    Source: `hwp_bench.importers.video.masks`, which the video import uses.
    """
    from hwp_bench.importers.video.masks import NARROW, Prompt, segment_clip

    if len(images) != len(silhouettes) or any(
        image.shape[:2] != drawn.shape for image, drawn in zip(images, silhouettes, strict=True)
    ):
        raise ShapeMismatch("do not fit the images", field="silhouettes")
    if not images:
        return

    def prompt(frame: int) -> Prompt:
        drawn = np.where(silhouettes[frame], 255, 0).astype(np.uint8)
        return Prompt.without_wrist(drawn, detected=True)

    segmented = segment_clip(
        lambda frame: np.ascontiguousarray(images[frame]),
        prompt,
        len(images),
        _hand_size(silhouettes),
        NARROW,
    )
    for _, masks in segmented:
        yield masks.hand > 127


def _hand_size(silhouettes: Sequence[np.ndarray]) -> float:
    """Median over the frames of the larger side of the silhouette's box, px."""
    sides = [
        max(np.ptp(np.flatnonzero(drawn.any(axis=axis))) + 1.0 for axis in (0, 1))
        for drawn in silhouettes
        if drawn.any()
    ]
    return float(np.median(sides)) if sides else 1.0
