"""Regions without a network: superpixels."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import sha256_json
from wildghand.pao.regions.frame_regions import FrameRegions, partition


@dataclass(frozen=True)
class Superpixels:
    """SLIC superpixels of a picture: small areas of like colour that follow edges."""

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
        """Digest of everything that the regions of a picture depend on."""
        return sha256_json(["slic-1", asdict(self)])

    def regions(self, picture: np.ndarray) -> FrameRegions:
        """Cut a picture into superpixels; the same picture gives the same ones.

        Args:
            picture: (H, W, 3) uint8 sRGB.

        Returns:
            A partition; at least one region, about `count`.

        Raises:
            UsageError: not such a picture, or an empty one.

        Source: Achanta et al., "SLIC superpixels compared to state-of-the-art superpixel
        methods"; OpenCV's implementation, small pieces joined to their neighbours.
        """
        import cv2

        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise UsageError(f"is {picture.dtype} of shape {picture.shape}", field="picture")
        height, width = picture.shape[:2]
        if height * width == 0:
            raise UsageError("has no pixel", field="picture")
        edge = max(1, round(math.sqrt(height * width / self.count)))
        lab = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2Lab)
        # A picture narrower than a superpixel makes OpenCV read beyond its end.
        below, right = max(0, 2 * edge - height), max(0, 2 * edge - width)
        lab = cv2.copyMakeBorder(lab, 0, below, 0, right, cv2.BORDER_REPLICATE)
        slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLIC, edge, self.compactness)
        slic.iterate(self.iterations)
        slic.enforceLabelConnectivity()
        return partition(slic.getLabels()[:height, :width])
