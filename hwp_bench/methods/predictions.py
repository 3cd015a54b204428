"""Check predicted frames before they are scored; only the frames of a submission count."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadImage
from hwp_bench.base.images import read_rgb
from hwp_bench.capture.schema import frame_name


@dataclass(frozen=True, eq=False)
class Prediction:
    """One predicted frame, or the reason why it cannot be scored."""

    #: Frame index in the capture.
    frame: int
    #: (H, W, 3) uint8 sRGB, or None.
    pixels: np.ndarray | None
    #: Why it cannot be scored, or None.
    failure: str | None


def read_prediction(
    folder: str | os.PathLike[str], frame: int, size: tuple[int, int]
) -> Prediction:
    """Read one predicted frame.

    Args:
        folder: where the predictions of a capture lie, `000123.png` for frame 123.
        frame: index of the frame.
        size: the capture's (height, width).

    Returns:
        The pixels, or a named failure: missing, a link, empty, damaged, not 8-bit, of another
        size. An alpha channel is dropped: the data set owns the mask.
    """
    path = Path(folder) / frame_name(frame)
    # A link could lead to the very frame that is to be predicted.
    if path.is_symlink():
        return Prediction(frame, None, f"{path.name}: is a link")
    try:
        return Prediction(frame, read_rgb(path, size), None)
    except BadImage as error:
        return Prediction(frame, None, f"{path.name}: {error.problem}")


def read_predictions(
    folder: str | os.PathLike[str], frames: Iterable[int], size: tuple[int, int]
) -> list[Prediction]:
    """Read the predictions of the given frames, in that order; other files are ignored."""
    return [read_prediction(folder, frame, size) for frame in frames]
