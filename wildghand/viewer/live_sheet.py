"""The picture of a fit that runs: frame, avatar and weights next to each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hwp_bench.base.drawing import PAPER, fitted, labelled
from wildghand.fitting.glance import Glance

#: Larger side of each of the three pictures, px.
TILE = 384
_GAP = 8


def live_sheet(look: Glance, aspect: float) -> np.ndarray:
    """Return the three pictures of a glance on a sheet.

    Args:
        look: what was seen.
        aspect: width over height of the sheet, from 0.1 to 10; the pictures stand in a row or in
            a column, where they are larger.

    Returns:
        (H, W, 3) uint8, H and W as `aspect` asks for.
    """
    names = (f"frame {look.frame}", f"avatar, {look.psnr:.1f} dB", "weights of pixels")
    pictures = (look.truth, look.avatar, np.repeat(look.weights[..., None], 3, axis=2))
    tiles = [
        labelled(fitted(image, TILE), name) for image, name in zip(pictures, names, strict=True)
    ]
    height, width = tiles[0].shape[:2]
    rows = [_line(tiles, 1), _line(tiles, 0)]
    inner = max(rows, key=lambda line: min(aspect / line.shape[1], 1.0 / line.shape[0]))
    height, width = inner.shape[:2]
    full = max(height, round(width / aspect)), max(width, round(height * aspect))
    page = np.full((*full, 3), PAPER, dtype=np.uint8)
    top, left = (full[0] - height) // 2, (full[1] - width) // 2
    page[top : top + height, left : left + width] = inner
    return page


def _line(tiles: Sequence[np.ndarray], axis: int) -> np.ndarray:
    """Tiles with gaps around them, along an axis of the picture."""
    padded = [
        np.pad(tile, ((_GAP, _GAP), (_GAP, _GAP), (0, 0)), constant_values=PAPER[0])
        for tile in tiles
    ]
    return np.concatenate(padded, axis=axis)
