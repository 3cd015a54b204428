"""An avatar inside a notebook: a picture or a turntable that a cell shows.

What is returned has the methods that notebooks look for; nothing here needs IPython.
"""

from __future__ import annotations

import base64
import importlib
import io
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import as_uint8

#: Frames of a turn, and milliseconds of each.
TURN_FRAMES, TURN_MS = 24, 100
#: Largest edge of an inline picture, px: it lies in the notebook's file.
MAX_EDGE = 2048
# Of WebP; a hand of 320 px turns in some 100 kB.
_QUALITY = 80


@dataclass(frozen=True)
class InlinePicture:
    """A picture that notebooks show where it is the value of a cell."""

    #: The encoded picture.
    data: bytes
    #: Its media type: `image/png` or `image/webp`.
    media: str
    #: Edge in the page, px.
    size: int
    #: Said in place of the picture where there are no pictures.
    text: str
    #: A page to show instead, whole HTML; None: there is no such page.
    page: str | None = None

    def __repr__(self) -> str:
        return f"InlinePicture({self.text})"

    def _repr_html_(self) -> str:
        """Return the picture as HTML that needs no other file."""
        if self.page is not None:
            source = _data_uri(self.page.encode(), "text/html")
            place = 'style="width:100%;height:540px;border:0"'
            return f'<iframe src="{source}" title="{self.text}" {place}></iframe>'
        source = _data_uri(self.data, self.media)
        return f'<img src="{source}" width="{self.size}" height="{self.size}" alt="{self.text}">'

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        """Return what a notebook stores: the picture where it knows its type, HTML, and text."""
        bundle: dict[str, Any] = {"text/html": self._repr_html_(), "text/plain": repr(self)}
        if self.media == "image/png" and self.page is None:
            # Notebooks store pictures as base64, and pages such as GitHub's show them.
            bundle["image/png"] = base64.b64encode(self.data).decode()
            del bundle["text/html"]
        return bundle


def still(
    rgba: np.ndarray, background: tuple[int, int, int], text: str, page: str | None = None
) -> InlinePicture:
    """Return one drawing over a colour.

    Args:
        rgba: (H, W, 4) float as `Avatar.render` gives it.
        background: sRGB, 0 to 255.
        text: what it shows.
        page: HTML to show instead, where there is a page.
    """
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(over(rgba, background)).save(buffer, format="PNG")
    return InlinePicture(buffer.getvalue(), "image/png", rgba.shape[1], text, page)


def turntable(
    draw: Callable[[float], np.ndarray], background: tuple[int, int, int], text: str
) -> InlinePicture:
    """Return a turn as an animated WebP image.

    Args:
        draw: takes degrees about the vertical, gives (H, W, 4) float as `Avatar.render` does.
        background: sRGB, 0 to 255.
        text: what it shows.
    """
    from PIL import Image

    turns = [360.0 * frame / TURN_FRAMES for frame in range(TURN_FRAMES)]
    frames = [Image.fromarray(over(draw(turn), background)) for turn in turns]
    buffer = io.BytesIO()
    frames[0].save(
        buffer,
        format="WEBP",
        save_all=True,
        append_images=frames[1:],
        duration=TURN_MS,
        loop=0,
        quality=_QUALITY,
    )
    return InlinePicture(buffer.getvalue(), "image/webp", frames[0].width, text)


def over(rgba: np.ndarray, background: tuple[int, int, int]) -> np.ndarray:
    """Return a drawing over a colour: (H, W, 3) uint8.

    Args:
        rgba: (H, W, 4) float in [0, 1], premultiplied.
        background: sRGB, 0 to 255.
    """
    behind = (1.0 - rgba[..., 3:]) * (np.array(background, dtype=np.float32) / 255.0)
    return as_uint8(rgba[..., :3] + behind)


def page_of(avatar: object) -> str:
    """Return the interactive page of an avatar as HTML."""
    # The page's room stands below this one, and is imported when it is asked for.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.html"
        importlib.import_module("wildghand.page").write_page(avatar, path)
        return path.read_text("utf-8")


def check_edge(size: int) -> None:
    """Check the edge of an inline picture.

    Raises:
        UsageError: it is not from 16 px to `MAX_EDGE`.
    """
    if not 16 <= size <= MAX_EDGE:
        raise UsageError(f"is {size}", field="size", remedy=f"Use 16 to {MAX_EDGE} px.")


def _data_uri(data: bytes, media: str) -> str:
    return f"data:{media};base64,{base64.b64encode(data).decode()}"
