"""Images made of images: labelled tiles on a sheet, error maps, outlines."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

#: Height of the line of text over a tile, px.
LABEL_HEIGHT = 18
#: Gap between tiles, px.
GAP = 4
#: Background of sheets.
PAPER = (250, 250, 250)
#: Colour of text.
INK = (30, 30, 30)
#: Error that is drawn as the hottest colour, in 8-bit levels.
HOT_ERROR = 64


def labelled(tile: np.ndarray, text: str) -> np.ndarray:
    """Return a tile (H, W, 3) uint8 with a line of text over it."""
    strip = np.full((LABEL_HEIGHT, tile.shape[1], 3), PAPER, dtype=np.uint8)
    # The vector fonts of OpenCV know ASCII only.
    shown = text.encode("ascii", "replace").decode()
    font = cv2.FONT_HERSHEY_SIMPLEX, 0.4
    while shown and cv2.getTextSize(shown, *font, 1)[0][0] > tile.shape[1] - 4:
        shown = shown[:-1]
    cv2.putText(strip, shown, (2, 13), *font, INK, 1, cv2.LINE_AA)
    return np.concatenate([strip, tile])


def sheet(tiles: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Return tiles (H, W, 3) laid out in rows; smaller ones are centred in the largest cell."""
    height = max(tile.shape[0] for tile in tiles) + GAP
    width = max(tile.shape[1] for tile in tiles) + GAP
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    page = np.full((rows * height + GAP, columns * width + GAP, 3), PAPER, dtype=np.uint8)
    for index, tile in enumerate(tiles):
        top = GAP + (index // columns) * height
        left = GAP + (index % columns) * width + (width - GAP - tile.shape[1]) // 2
        page[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return page


def outlined(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return an image (H, W, 3) with the outline of a mask (H, W), whose inside is above 127."""
    contours, _ = cv2.findContours(
        (mask > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE
    )
    return cv2.drawContours(image.copy(), contours, -1, (0, 255, 80), 1, cv2.LINE_8)


def error_map(prediction: np.ndarray, target: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the error of a prediction in colours, black outside the mask.

    It is the largest channel's absolute difference, from dark (0) to bright yellow (`HOT_ERROR`
    levels and more): (H, W, 3) uint8, as both images.
    """
    difference = np.abs(prediction.astype(np.int16) - target).max(axis=2)
    levels = np.clip(difference * (255 / HOT_ERROR), 0, 255).astype(np.uint8)
    colours = cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[:, :, ::-1]
    return np.where(mask[:, :, None], colours, 0).astype(np.uint8)


def fitted(image: np.ndarray, edge: int) -> np.ndarray:
    """Return an image resampled so that its larger side is `edge` px; small ones grow evenly."""
    scale = edge / max(image.shape[:2])
    if scale >= 2:
        scale = float(int(scale))
    if scale == 1:
        return image
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=method)
