"""Regions and hands of Segment Anything, where the user has a checkpoint."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import torch

from hwp_bench.base.files import sha256_json
from wildghand.pao.regions.frame_regions import FrameRegions, overlapping
from wildghand.sam import (
    AutomaticSettings,
    SamNetwork,
    SeenImage,
    automatic_masks,
    checkpoint_digest,
    load_network,
)

#: Which automatic masks are kept by default, as in the public code.
PUBLIC = AutomaticSettings()


class SegmentAnything:
    """Overlapping regions of an image, and the object at a pixel.

    The network is loaded when the first image is cut that no cache has.

    Args:
        identity: digest of the network, where it runs, and its options.
        load: loads the network.
        settings: which automatic masks are kept; None: as in the public code.
    """

    def __init__(
        self,
        identity: str,
        load: Callable[[], SamNetwork],
        settings: AutomaticSettings | None = None,
    ) -> None:
        self._settings = settings or PUBLIC
        self.identity = sha256_json([identity, asdict(self._settings)])
        self._load = load
        self._network: SamNetwork | None = None

    @property
    def network(self) -> SamNetwork:
        """The network, loaded when it is needed first."""
        if self._network is None:
            self._network = self._load()
        return self._network

    def regions(self, image: np.ndarray) -> FrameRegions:
        """The automatic masks of an (H, W, 3) uint8 sRGB image; there may be none."""
        return overlapping(automatic_masks(self.network, image, self._settings))

    def hand(self, image: np.ndarray, roots: tuple[tuple[float, float], ...]) -> np.ndarray:
        """y_h: the best of three masks at each projected hand root, all hands together.

        Args:
            image: (H, W, 3) uint8 sRGB.
            roots: (x, y) px of each hand, the centre of the top left pixel at 0.5.

        Returns:
            (H, W) bool; roots off the image add nothing.
        """
        height, width = image.shape[:2]
        mask = np.zeros((height, width), dtype=bool)
        inside = [(x, y) for x, y in roots if 0.0 <= x < width and 0.0 <= y < height]
        if inside:
            seen = self.network.see(image)
            for root in inside:
                mask |= _best_mask(seen, root)
        return mask


@dataclass(frozen=True)
class PromptedHand:
    """The hand of one frame as a segmenter, so that the cache of regions keeps it."""

    #: Finds it.
    sam: SegmentAnything
    #: (x, y) px of each hand's root.
    roots: tuple[tuple[float, float], ...]

    @property
    def identity(self) -> str:
        """Digest of network and prompts; a thousandth of a pixel decides nothing."""
        places = [[str(round(part, 3)) for part in root] for root in self.roots]
        return sha256_json(["hand", self.sam.identity, places])

    def regions(self, image: np.ndarray) -> FrameRegions:
        """The hand as the only region."""
        return overlapping(self.sam.hand(image, self.roots)[None])


def mask_of(regions: FrameRegions) -> np.ndarray:
    """The union of overlapping regions, (H, W) bool."""
    assert regions.membership is not None
    return np.asarray(regions.membership.any(axis=1))[regions.labels]


def open_sam(checkpoint: str | os.PathLike[str], device: str = "cpu") -> SegmentAnything:
    """Open a Segment Anything checkpoint on the user's disk; nothing is downloaded.

    Args:
        checkpoint: a folder in the layout of `transformers` (config.json and weights), or a
            .pth file of the package `segment-anything`. Neither package is needed.
        device: torch device.

    Raises:
        BadInput: it is missing; when the first image is cut, also: it cannot be read, or is of
            another network.
    """
    # A graphics card rounds differently, and a mask may turn on it.
    identity = sha256_json([checkpoint_digest(checkpoint), torch.device(device).type])
    return SegmentAnything(identity, lambda: load_network(checkpoint, device))


def _best_mask(seen: SeenImage, root: tuple[float, float]) -> np.ndarray:
    coarse, quality = seen.masks_at(torch.tensor([root], dtype=torch.float64))
    best = coarse[0, quality[0].argmax()]
    return (seen.full(best[None])[0] > 0.0).cpu().numpy()
