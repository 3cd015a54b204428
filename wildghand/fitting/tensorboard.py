"""A fit in TensorBoard: curves and pictures of a training frame, while it runs."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.packages import import_extra
from wildghand.fitting.glance import LEAST_PAUSE, Glance, Live
from wildghand.fitting.session import Watch

# Seconds between two pictures; a curve has a point for every look.
_PICTURES = 30.0


@contextlib.contextmanager
def logging_fit(
    folder: Path | None, watch: Watch | None = None, pause: float = LEAST_PAUSE
) -> Iterator[Watch | None]:
    """Yield what a fit calls after each step: `watch`, and what writes event files to a folder.

    Curves are the loss and the PSNR (dB) over the hand in the first training frame, which is drawn
    once in `pause` seconds at most. Without a folder nothing is written.
    """
    if folder is None:
        yield watch
        return
    problem = "tensorboard is not installed"
    writers = import_extra("torch.utils.tensorboard", "tensorboard", problem)
    drawn = -math.inf

    def show(look: Glance) -> None:
        nonlocal drawn
        writer.add_scalar("fit/loss", look.loss, look.step)
        writer.add_scalar("fit/psnr", look.psnr, look.step)
        if time.monotonic() >= drawn + _PICTURES:
            weights = np.repeat(look.weights[..., None], 3, axis=2)
            sheet = np.concatenate([look.truth, look.avatar, weights], axis=1)
            writer.add_image("fit/frame_avatar_weights", sheet, look.step, dataformats="HWC")
            drawn = time.monotonic()
        writer.flush()

    watches: list[Watch] = [*([watch] if watch else []), Live(show, pause=pause)]

    def call(*looked: Any) -> None:
        for one in watches:
            one(*looked)

    with contextlib.closing(writers.SummaryWriter(folder)) as writer:
        yield call
