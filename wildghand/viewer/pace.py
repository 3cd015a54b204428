"""How large a picture may be so that the next one comes soon."""

from __future__ import annotations

import math

#: Seconds that a picture may take while something moves: some ten pictures a second.
TARGET = 0.09
#: Smallest and largest edge of such a picture, px.
LEAST, MOST = 128, 768


class Pace:
    """Follows how long pictures take, and says how large the next one may be.

    Args:
        edge: of the first picture, px.
    """

    def __init__(self, edge: int = 256) -> None:
        self.edge = edge

    def took(self, edge: int, pixels: float, other: float) -> None:
        """Take note of a picture.

        Args:
            edge: its larger side, px.
            pixels: seconds that grow with the number of its pixels.
            other: seconds of what does not, such as posing.
        """
        # At least a third of the time goes to the pixels: smaller pictures would not help.
        left = max(TARGET - other, TARGET / 3)
        wanted = edge * math.sqrt(left / max(pixels, 1e-4))
        # Halfway, so that one slow picture on a busy machine does not make the next one tiny.
        self.edge = round(min(max(math.sqrt(self.edge * wanted), LEAST), MOST))
