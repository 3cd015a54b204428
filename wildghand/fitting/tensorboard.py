"""Curves of a fit in TensorBoard, while it runs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from hwp_bench.base.packages import import_extra
from wildghand.fitting.fit import Fit
from wildghand.fitting.glance import LEAST_PAUSE, Glance, Live
from wildghand.fitting.session import Watch
from wildghand.gaussians.fit_loop import Loss


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
    import_extra("tensorboard", "tensorboard", problem)
    writers = import_extra("torch.utils.tensorboard", "tensorboard", problem)

    def show(look: Glance) -> None:
        writer.add_scalar("fit/loss", look.loss, look.step)
        writer.add_scalar("fit/psnr", look.psnr, look.step)
        writer.flush()

    live = Live(show, pause=pause)

    def call(fit: Fit, step: int, loss: Loss) -> None:
        live(fit, step, loss)
        if watch is not None:
            watch(fit, step, loss)

    with contextlib.closing(writers.SummaryWriter(folder)) as writer:
        yield call
