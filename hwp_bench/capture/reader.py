"""Open a capture folder: metadata and numbers are checked at once, images as they are read."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadCapture, UsageError
from hwp_bench.base.files import read_json, sha256_json
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.capture.layout import (
    CAMERAS,
    HANDS,
    IMAGE_FOLDERS,
    METADATA,
    TRUE_HANDS,
    image_path,
)
from hwp_bench.capture.schema import CaptureInfo
from hwp_bench.capture.tracks import Cameras, read_cameras, read_hands
from hwp_bench.hands.parameters import HandParameters


class Capture:
    """A capture on disk.

    Attributes:
        root: the folder.
        info: what the capture says of itself.
        hands: estimated hand parameters by side.
        cameras: one camera a frame.
    """

    def __init__(
        self,
        root: Path,
        info: CaptureInfo,
        hands: dict[str, HandParameters],
        cameras: Cameras,
    ) -> None:
        self.root = root
        self.info = info
        self.hands = hands
        self.cameras = cameras

    def __len__(self) -> int:
        return self.info.frame_count

    def __repr__(self) -> str:
        info = self.info
        return f"Capture({info.id!r}, {info.frame_count} frames, {info.width}x{info.height})"

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of every frame, px."""
        return self.info.height, self.info.width

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the metadata and of the digests of every part."""
        return sha256_json(self.info.to_json())

    @property
    def has_clean(self) -> bool:
        """Whether the clean version of every frame is known."""
        return (self.root / IMAGE_FOLDERS["clean"]).is_dir()

    @property
    def has_true_masks(self) -> bool:
        """Whether the exact visible-hand coverage is known."""
        return (self.root / IMAGE_FOLDERS["true_masks"]).is_dir()

    @cached_property
    def true_hands(self) -> dict[str, HandParameters] | None:
        """True hand parameters by side, where they are known."""
        path = self.root / TRUE_HANDS
        if not path.is_file():
            return None
        return read_hands(path, self.info.sides, self.info.frame_count)

    def frame(self, frame: int) -> np.ndarray:
        """Read one frame: (H, W, 3) uint8 sRGB.

        Raises:
            BadImage: missing, damaged or of another size.
            UsageError: there is no such frame.
        """
        return read_rgb(self._path("frames", frame), self.size)

    def mask(self, frame: int) -> np.ndarray:
        """Read the visible-hand mask that methods are given: (H, W) uint8, 255 = hand."""
        return read_gray(self._path("masks", frame), self.size)

    def clean(self, frame: int) -> np.ndarray:
        """Read the clean version of a frame: (H, W, 3) uint8 sRGB."""
        return read_rgb(self._path("clean", frame), self.size)

    def true_mask(self, frame: int) -> np.ndarray:
        """Read the exact coverage of visible hand: (H, W) uint8, 255 = covered fully."""
        return read_gray(self._path("true_masks", frame), self.size)

    def clean_mask(self, frame: int) -> np.ndarray:
        """Read the visible hand of the clean frame: (H, W) uint8, 255 = covered fully."""
        return read_gray(self._path("clean_masks", frame), self.size)

    def scoring_mask(self, frame: int) -> tuple[np.ndarray, bool]:
        """Read the mask that scores are taken over.

        Returns:
            The mask (H, W) uint8, and whether it is exact coverage (True) or an estimate.
        """
        if self.has_true_masks:
            return self.true_mask(frame), True
        return self.mask(frame), False

    def _path(self, kind: str, frame: int) -> Path:
        if not 0 <= frame < self.info.frame_count:
            raise UsageError(
                f"there is no frame {frame}, only 0 to {self.info.frame_count - 1}", where=self.root
            )
        return image_path(self.root, kind, frame)


def open_capture(path: str | os.PathLike[str]) -> Capture:
    """Open a capture folder.

    Args:
        path: the folder that holds `capture.json`.

    Returns:
        The capture; images are read (and checked) when they are asked for.

    Raises:
        BadCapture: no capture folder, or its metadata is wrong; file and field are named.
        BadInput: hand parameters or cameras are damaged, not finite, or of another length.
    """
    root = Path(path)
    if not (root / METADATA).is_file():
        raise BadCapture(
            f"is no capture: it has no {METADATA}",
            where=root,
            remedy="Give the folder of one capture.",
        )
    metadata = root / METADATA
    info = CaptureInfo.from_json(read_json(metadata), where=os.fspath(metadata))
    return Capture(
        root,
        info,
        hands=read_hands(root / HANDS, info.sides, info.frame_count),
        cameras=read_cameras(root / CAMERAS, info.frame_count),
    )
