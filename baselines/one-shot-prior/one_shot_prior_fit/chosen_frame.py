"""Choosing the one training frame of the preset `one-shot`."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from wildghand.gaussians.training import TrainingFrames

# Frames whose hand is at least this share of the largest one show as much of it.
_LARGE = 0.9


def choose_frame(frames: TrainingFrames) -> int:
    """The row of the frame that shows much of the hand, and shows it sharply.

    Among the frames whose mask has at least nine tenths of the largest mask's area, it is the one
    with the largest mean magnitude of the Laplacian within the mask: blur and covered skin
    lower one or the other. The first of equals is taken.

    Args:
        frames: the training frames.
    """
    areas = (frames.masks > 127).flatten(1).sum(dim=1).numpy()
    rows = np.flatnonzero(areas >= _LARGE * areas.max())
    sharp = [_edge_strength(frames, row) for row in rows.tolist()]
    return int(rows[int(np.argmax(sharp))])


def only(frames: TrainingFrames, row: int) -> TrainingFrames:
    """One row of the training frames."""
    part = slice(row, row + 1)
    return replace(
        frames,
        indices=frames.indices[part],
        images=frames.images[part],
        masks=frames.masks[part],
    )


def _edge_strength(frames: TrainingFrames, row: int) -> float:
    image = frames.images[row].numpy().astype(np.float32).mean(axis=-1)
    # The outline against the background says nothing of the skin.
    mask = (frames.masks[row].numpy() > 127).astype(np.uint8)
    inside = cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0
    if not inside.any():
        return 0.0
    return float(np.abs(cv2.Laplacian(image, cv2.CV_32F))[inside].mean())
