"""A look at a fit while it runs: a training frame, the avatar in its place and turned, the weights.

Looking changes nothing: a fit that is watched gives the same bits as one that is not.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.base.console import notice
from hwp_bench.base.images import as_uint8
from wildghand.fitting.fit import Fit, StepBatch
from wildghand.fitting.weights import Pao
from wildghand.gaussians.fit_loop import Loss
from wildghand.splat.threads import denormals_flushed

#: Least seconds between two looks, and the largest share of the time that goes into them.
LEAST_PAUSE, SHARE = 1.0, 0.1
#: Looks in which the avatar turns once.
LOOKS_PER_TURN = 24


@dataclass(frozen=True, eq=False)
class Glance:
    """One training frame in the middle of a fit."""

    #: Optimizer steps so far.
    step: int
    #: Loss of the last step.
    loss: float
    #: Frame of the capture.
    frame: int
    #: dB, of the avatar against the frame over the pixels of the hand; NaN where there are none.
    psnr: float
    #: (H, W, 3) uint8: the frame.
    truth: np.ndarray
    #: (H, W, 3) uint8 over black: the avatar in the frame's pose, without what perturbed it.
    avatar: np.ndarray
    #: (H, W) uint8: how much each pixel counts, 255 for the largest weight.
    weights: np.ndarray
    #: (H, W, 3) uint8 over black: the avatar in the frame's pose, seen from around it.
    turned: np.ndarray


@denormals_flushed()
@torch.no_grad()
def glance(fit: Fit, row: int, step: int, loss: float, angle: float = 0.0) -> Glance:
    """Look at one of the frames that are fitted.

    Args:
        angle: rad, of the camera about the hands for the turned picture.
    """
    batch, pao, training = StepBatch(torch.tensor([row])), fit.part(Pao), fit.data.training
    # Weighing a frame moves the running medians along.
    before = {} if pao is None else pao.state_dict()
    try:
        target = fit.compare(batch, fit.draw(batch))
    finally:
        if pao is not None:
            pao.load_state_dict(before)
    without = {side: torch.tensor([False]) for side in fit.model.perturbation}
    drawn = fit.draw(batch, kept=without).image[0] / fit.model.log_gains[row].exp()
    frame = int(fit.data.frames.indices[row])
    truth = training.frame(frame)
    image = _pixels(drawn)
    weights = target.weights[0].float()
    share = weights / weights.max().clamp(min=1e-12)
    return Glance(
        step=step,
        loss=loss,
        frame=frame,
        psnr=_psnr(image, truth, training.mask(frame) > 127),
        truth=truth,
        avatar=as_uint8(image),
        weights=(255.0 * share).round().byte().cpu().numpy(),
        turned=_turned(fit, row, angle),
    )


def _turned(fit: Fit, row: int, angle: float) -> np.ndarray:
    """Draw the avatar in a frame's pose from a camera that is turned about the hands, upright."""
    clip, training, rows = fit.clip, fit.data.training, torch.tensor([row], device=fit.device)
    viewmat = clip.viewmats[row].double()
    middle = clip.poses(rows).positions[0].double().mean(dim=0)
    seen = viewmat[:3, :3] @ middle + viewmat[:3, 3]
    cos, sin = math.cos(angle), math.sin(angle)
    about = torch.eye(4, dtype=torch.float64, device=fit.device)
    about[0, 0], about[0, 2], about[2, 0], about[2, 2] = cos, sin, -sin, cos
    about[:3, 3] = seen - about[:3, :3] @ seen
    image, _ = fit.model.draw(
        clip.given(rows),
        (about @ viewmat).float()[None],
        clip.Ks[rows],
        training.width,
        training.height,
        refine=fit.settings.heads,
    )
    return as_uint8(_pixels(image[0]))


def _pixels(image: torch.Tensor) -> np.ndarray:
    return image.clamp(0.0, 1.0).nan_to_num(0.0).float().cpu().numpy()


def _psnr(image: np.ndarray, truth: np.ndarray, hand: np.ndarray) -> float:
    if not hand.any():
        return math.nan
    error = float(np.square(image[hand] - truth[hand] / 255.0).mean())
    return -10.0 * math.log10(max(error, 1e-10))


class Live:
    """Looks at a fit now and then; see `wildghand.fitting.session.Watch`.

    Args:
        show: takes what was seen.
        wanted: whether anybody looks.
        row: which training frame is looked at.
        pause: seconds between two looks at least; 0 looks after every step.
    """

    def __init__(
        self,
        show: Callable[[Glance], None],
        wanted: Callable[[], bool] = lambda: True,
        row: Callable[[int], int] = lambda count: 0,
        pause: float = LEAST_PAUSE,
    ) -> None:
        self._show, self._wanted, self._row, self._pause = show, wanted, row, pause
        self._due, self._looks = 0.0, 0

    def __call__(self, fit: Fit, step: int, loss: Loss) -> None:
        """Look, where it is time to."""
        began = time.monotonic()
        if began < self._due or not self._wanted():
            return
        try:
            angle = math.tau * self._looks / LOOKS_PER_TURN
            self._show(glance(fit, self._row(len(fit.data.frames)), step, float(loss), angle))
            self._looks += 1
        except OSError as error:  # the network's: a page that is gone must not end a fit
            notice(f"The fit cannot be shown ({error}).")
        now = time.monotonic()
        self._due = now + max(self._pause, (now - began) * (1.0 / SHARE - 1.0) * bool(self._pause))
