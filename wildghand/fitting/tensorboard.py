"""A fit in TensorBoard: its curves, its speed and pictures of a training frame, while it runs."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import MissingDependency
from wildghand.fitting.fit import Fit
from wildghand.fitting.glance import LEAST_PAUSE, Glance, Live
from wildghand.fitting.session import Watch
from wildghand.gaussians.fit_loop import Loss

# Seconds between two pictures; a curve has a point for every look.
_PICTURES = 30.0


@contextlib.contextmanager
def logging_fit(
    folder: Path | None, watch: Watch | None = None, pause: float = LEAST_PAUSE
) -> Iterator[Watch | None]:
    """Yield what a fit calls after each step: `watch`, and what writes event files to a folder.

    The first training frame is looked at, once in `pause` seconds at most and for a tenth of the
    time. Loss, PSNR over the pixels of the hand (dB) and steps in a second become curves. Without a
    folder nothing is written.

    Raises:
        MissingDependency: tensorboard is not installed.
    """
    if folder is None:
        yield watch
        return
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise MissingDependency(
            "tensorboard is not installed", remedy="pip install 'hwp-bench[tensorboard]'"
        ) from error
    seen, moment, drawn = 0, math.inf, -math.inf

    def show(look: Glance) -> None:
        nonlocal seen, moment, drawn
        now = time.monotonic()
        writer.add_scalar("fit/loss", look.loss, look.step)
        writer.add_scalar("fit/psnr", look.psnr, look.step)
        if now > moment:
            speed = (look.step - seen) / (now - moment)
            writer.add_scalar("fit/steps_per_second", speed, look.step)
        seen, moment = look.step, now
        if now >= drawn + _PICTURES:
            weights = np.repeat(look.weights[..., None], 3, axis=2)
            sheet = np.concatenate([look.truth, look.avatar, weights], axis=1)
            writer.add_image("fit/frame_avatar_weights", sheet, look.step, dataformats="HWC")
            drawn = now
        writer.flush()

    live = Live(show, pause=pause)

    def both(fit: Fit, step: int, loss: Loss) -> None:
        if watch is not None:
            watch(fit, step, loss)
        live(fit, step, loss)

    with contextlib.closing(SummaryWriter(folder)) as writer:
        yield both
