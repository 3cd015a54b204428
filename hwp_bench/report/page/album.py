"""Images inside the page: small JPEGs as data URIs, within a budget of bytes."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import fitted, labelled, sheet
from hwp_bench.base.errors import HwpError
from hwp_bench.base.images import read_rgb
from hwp_bench.report.sources import ResultsSource

#: Largest sum of the images in a page, bytes in base64.
MAX_BYTES = 8 * 1024 * 1024
#: Quality of the JPEGs: the sheets are for looking, the results keep the exact pixels.
QUALITY = 82
#: Larger edge of an image in the page, px.
EDGE = 1056
#: Weight masks shown of one capture, and their larger edge, px.
MASKS, MASK_EDGE = 6, 160


class Album:
    """Collects images until the budget is spent.

    Attributes:
        left: bytes that are left.
        left_out: how many images the budget did not allow.
    """

    def __init__(self, budget: int = MAX_BYTES) -> None:
        self.left = budget
        self.left_out = 0

    def take(self, pixels: np.ndarray) -> str | None:
        """Return an image as a data URI, or None where the budget does not allow it.

        Args:
            pixels: (H, W, 3) uint8.
        """
        if max(pixels.shape[:2]) > EDGE:
            pixels = fitted(pixels, EDGE)
        done, data = cv2.imencode(
            ".jpg", np.ascontiguousarray(pixels[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
        )
        uri = "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
        if not done or len(uri) > self.left:
            self.left_out += 1
            return None
        self.left -= len(uri)
        return uri

    def take_file(self, path: Path | None) -> str | None:
        """Return an image file as a data URI; None if it is missing or beyond the budget."""
        pixels = _read(path)
        return None if pixels is None else self.take(pixels)


def frame_sheets(source: ResultsSource, capture: str, album: Album) -> str | None:
    """Return the sheet of worst, median and best frame that the evaluation drew."""
    return album.take_file(source.place(capture, "pictures", "comparison.png"))


def free_view_sheet(source: ResultsSource, capture: str, album: Album) -> str | None:
    """Return the sheet of views of the free-view clip that the evaluation drew."""
    return album.take_file(source.place(capture, "pictures", "free_view.png"))


def mask_sheet(source: ResultsSource, capture: str, album: Album) -> tuple[str, int] | None:
    """Return a sheet of a method's weight masks and how many there are, or None.

    At most `MASKS` are shown, spread evenly over the frames.
    """
    folder = source.place(capture, "diagnostics", "weights")
    if folder is None or not folder.is_dir():
        return None
    files = sorted(path for path in folder.iterdir() if re.fullmatch(r"\d{6}\.png", path.name))
    if not files:
        return None
    tiles = []
    for path in (files[index] for index in evenly(len(files), MASKS)):
        pixels = _read(path)
        if pixels is not None:
            tiles.append(labelled(fitted(pixels, MASK_EDGE), f"frame {int(path.stem)}"))
    uri = album.take(sheet(tiles, columns=3)) if tiles else None
    return (uri, len(files)) if uri else None


def _read(path: Path | None) -> np.ndarray | None:
    """Return (H, W, 3) uint8; None where the file is missing or not an image."""
    if path is None or not path.is_file():
        return None
    try:
        return read_rgb(path)
    except HwpError:
        return None
