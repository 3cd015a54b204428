"""The pictures of a report: sheets as data URIs within a budget, and copies of avatars' pages."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import fitted, labelled, sheet
from hwp_bench.base.errors import BadResult, HwpError
from hwp_bench.base.files import atomic_write
from hwp_bench.base.images import read_rgb
from hwp_bench.report.sources import ResultsSource

#: Name of a page within `captures/ID/` of a results folder.
AVATAR_PAGE = "avatar.html"
#: Largest page, bytes.
MAX_PAGE_BYTES = 32 << 20

#: Addresses by number of the result and id of the capture.
AvatarPages = dict[tuple[int, str], str]


def copy_avatar_pages(folder: Path, sources: Sequence[ResultsSource]) -> AvatarPages:
    """Copy pages of avatars next to a report."""
    found: AvatarPages = {}
    for index, source in enumerate(sources):
        for number, capture in enumerate(source.results.captures):
            path = source.place(capture.id, AVATAR_PAGE)
            if path is None or not path.exists():
                continue
            address = f"avatars/{index}-{number}.html"
            atomic_write(folder / address, _read(path))
            found[index, capture.id] = address
    return found


def _read(path: Path) -> str:
    if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_PAGE_BYTES:
        raise BadResult(f"must be a file of at most {MAX_PAGE_BYTES >> 20} MiB", where=path)
    try:
        text = path.read_text("utf-8")
    except UnicodeDecodeError:
        text = ""
    if not text.lstrip()[:15].lower().startswith("<!doctype html"):
        raise BadResult("is not an HTML page", where=path, remedy="Make it with `wildghand page`.")
    return text


#: Largest sum of the images in a page, bytes in base64.
MAX_BYTES = 8 * 1024 * 1024
#: Quality of the JPEGs: the sheets are for looking, the results keep the exact pixels.
QUALITY = 82
#: Larger edge of an image in the page, px.
EDGE = 1056
#: Weight masks shown of one capture, and their larger edge, px.
MASKS, MASK_EDGE = 6, 160


class Album:
    """Turns images into data URIs until the budget of bytes (`left`) is spent."""

    def __init__(self, budget: int = MAX_BYTES) -> None:
        self.left = budget
        #: How many images the budget did not allow.
        self.left_out = 0

    def take(self, pixels: np.ndarray | None) -> str | None:
        """Return a (H, W, 3) uint8 image as a data URI; None without one, or beyond the budget."""
        if pixels is None:
            return None
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


def mask_sheet(source: ResultsSource, capture: str, album: Album) -> tuple[str, int] | None:
    """Return a sheet of a method's weight masks and how many there are, or None.

    At most `MASKS` are shown, spread evenly over the frames.
    """
    folder = source.place(capture, "diagnostics", "weights")
    if folder is None or not folder.is_dir():
        return None
    files = sorted(path for path in folder.iterdir() if re.fullmatch(r"\d{6}\.png", path.name))
    shown = [files[index] for index in evenly(len(files), MASKS)] if files else []
    read = [(path, pixels) for path in shown if (pixels := read_picture(path)) is not None]
    tiles = [labelled(fitted(pixels, MASK_EDGE), f"frame {int(p.stem)}") for p, pixels in read]
    uri = album.take(sheet(tiles, columns=3)) if tiles else None
    return (uri, len(files)) if uri else None


def read_picture(path: Path | None) -> np.ndarray | None:
    """Return (H, W, 3) uint8; None where the file is missing or not an image."""
    if path is None or not path.is_file():
        return None
    try:
        return read_rgb(path)
    except HwpError:
        return None
