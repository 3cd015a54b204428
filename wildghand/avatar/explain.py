"""What DPD took out of training frames: the hand without biases, with them, the difference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import as_uint8
from hwp_bench.capture import Capture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.gaussians.training import TrainingClip
from wildghand.model.frames import largest
from wildghand.model.model import WildGHandModel
from wildghand.splat.threads import denormals_flushed

#: How much a difference of colours is stretched around grey in a picture.
_STRETCH = 2.0


@dataclass(frozen=True, eq=False)
class Explanation:
    """One training frame, and the avatar's part in it."""

    #: Frame of the capture.
    frame: int
    #: Temporal weight of largest magnitude among the hands.
    omega: float
    #: (H, W, 3) sRGB in [0, 1]: the frame over black outside the estimated mask.
    image: np.ndarray
    #: (H, W, 3) the hand as the avatar draws it: no bias, no gain.
    canonical: np.ndarray
    #: (H, W, 3) the hand with the frame's biases and gain.
    biased: np.ndarray


@denormals_flushed()
@torch.no_grad()
def explain_frames(
    avatar: WildGHandAvatar, capture: Capture, frames: Sequence[int] | None = None
) -> list[Explanation]:
    """Draw training frames without and with what is particular to them.

    Args:
        avatar: fitted to the capture.
        capture: what it was fitted to.
        frames: of the capture; None: the eight of largest temporal weight, in order of time.

    Raises:
        UsageError: a frame was not fitted, the avatar has no biases, or it comes from another
            capture.
    """
    model, fitted = avatar.model, avatar.record.frames
    if not model.perturbation:
        raise UsageError(
            "was fitted without DPD", field="avatar", remedy="Fit it with dpd.enabled=true."
        )
    origin = avatar.record.source.get("capture")
    if origin not in (None, capture.info.id) or not fitted or max(fitted) >= len(capture):
        raise UsageError(
            f"was fitted to {str(origin)[:100]!r}, not to {capture.info.id!r}", field="avatar"
        )
    rows = torch.arange(len(fitted))
    omegas = largest([hand.temporal(rows).omega for hand in model.biases]).abs()
    if frames is None:
        frames = sorted(fitted[row] for row in omegas.argsort(descending=True)[:8].tolist())
    for frame in frames:
        if frame not in fitted:
            raise UsageError(f"{frame} was not fitted", field="frames")
    clip = TrainingClip(capture, np.array(fitted), model.rigs, torch.device("cpu"))
    found = []
    for frame in frames:
        row = fitted.index(frame)
        biased, canonical = (
            _drawn(model, clip, row, capture, avatar.settings.heads.refinement, biases=on)
            for on in (True, False)
        )
        mask = capture.mask(frame)[..., None] / 255.0
        found.append(
            Explanation(
                frame, float(omegas[row]), capture.frame(frame) / 255.0 * mask, canonical, biased
            )
        )
    return found


def explanation_sheet(
    found: Sequence[Explanation], names: Mapping[int, str] | None = None
) -> np.ndarray:
    """A sheet with a row for each frame.

    Args:
        found: at least one.
        names: what acts in a frame, for its caption.

    Returns:
        (H, W, 3) uint8: frame, without biases, with biases, and the difference of the two, grey
        where there is none.
    """
    tiles = []
    for item in found:
        acting = (names or {}).get(item.frame, "")
        difference = 0.5 + _STRETCH * (item.biased - item.canonical)
        for picture, caption in (
            (item.image, f"frame {item.frame} {acting}"),
            (item.canonical, "canonical"),
            (item.biased, f"with biases, omega {item.omega:.2f}"),
            (difference, f"difference x {_STRETCH:g}"),
        ):
            tiles.append(labelled(as_uint8(np.clip(picture, 0.0, 1.0).astype(np.float32)), caption))
    return sheet(tiles, 4)


def _drawn(
    model: WildGHandModel,
    clip: TrainingClip,
    row: int,
    capture: Capture,
    refine: bool,
    *,
    biases: bool,
) -> np.ndarray:
    rows = torch.tensor([row])
    kept = {side: torch.tensor([biases]) for side in model.perturbation}
    info = capture.info
    drawing = model.draw_frames(
        clip, rows, info.width, info.height, kept=kept, move=True, refine=refine
    )
    image = drawing.image[0]
    if not biases:
        image = image / model.log_gains[row].exp()
    return image.clamp(0.0, 1.0).numpy()
