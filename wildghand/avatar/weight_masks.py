"""Weight masks of an avatar as images: how much each pixel of a training frame counted."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hwp_bench.base.images import read_gray, write_image
from wildghand.avatar.avatar import WildGHandAvatar

# More than any fit writes.
_MOST = 1000


def write_weight_masks(avatar: WildGHandAvatar, folder: Path) -> None:
    """Write the weight masks that the avatar knows as images, named by frame."""
    for frame, mask in sorted(avatar.weight_masks.items()):
        write_image(folder / f"{frame:06d}.png", mask)


def read_weight_masks(folder: Path, frames: list[int]) -> dict[int, np.ndarray]:
    """Read the weight masks of frames that an avatar was fitted to.

    Args:
        folder: of the images; it may be absent.
        frames: those that were fitted; images of other frames are left out.

    Returns:
        (H, W) uint8 by frame.

    Raises:
        BadInput: an image is damaged.
    """
    named = {frame: folder / f"{frame:06d}.png" for frame in frames}
    found = sorted(path.name for path in folder.glob("*.png")) if folder.is_dir() else []
    there = {int(name[:6]) for name in found[:_MOST] if re.fullmatch(r"\d{6}\.png", name)}
    return {frame: read_gray(path) for frame, path in named.items() if frame in there}
