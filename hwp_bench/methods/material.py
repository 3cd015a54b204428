"""What a method is trained on: the frames as captured, or an oracle's choice of them.

The oracles bound what any method can reach on a simulated capture: the same fit on the clean
version of every frame, and the same fit on those frames alone that nothing perturbs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.capture.layout import IMAGE_FOLDERS
from hwp_bench.capture.splits import Split
from hwp_bench.hands.parameters import HandParameters

if TYPE_CHECKING:
    from hwp_bench.capture import Capture

#: Training frames as they were captured; their clean versions; only those without perturbation.
FRAME_CHOICES = ("perturbed", "clean", "unperturbed-only")


@dataclass(frozen=True, eq=False)
class Material:
    """Where the training part of a request comes from."""

    #: Indices of the training frames.
    train: np.ndarray
    #: Kind of image that is given as frames, a key of `IMAGE_FOLDERS`.
    frames: str
    #: Kind of image that is given as masks.
    masks: str
    #: Hand parameters by side.
    hands: dict[str, HandParameters]


def training_material(capture: Capture, split: Split, choice: str) -> Material:
    """Return what a method is given of a capture.

    Args:
        capture: the capture.
        split: its split.
        choice: one of `FRAME_CHOICES`. `clean` gives, besides clean frames and their masks, the
            true hand parameters in perturbed frames: an estimator would not have been misled.

    Raises:
        UsageError: no such choice, or the capture does not know its clean frames or severities;
            or no training frame is unperturbed.
    """
    if choice not in FRAME_CHOICES:
        raise UsageError(f"{choice!r} is none of {', '.join(FRAME_CHOICES)}", field="frames")
    hands = dict(capture.hands)
    if choice == "perturbed":
        return Material(split.train, "frames", "masks", hands)
    perturbed = _perturbed(capture)
    if choice == "unperturbed-only":
        train = split.train[~perturbed[split.train]]
        if not len(train):
            raise UsageError("has no unperturbed training frame", where=capture.root)
        return Material(train, "frames", "masks", hands)
    truth = capture.true_hands
    missing = [
        kind
        for kind in ("clean", "clean_masks")
        if not (capture.root / IMAGE_FOLDERS[kind]).is_dir()
    ]
    if truth is None or missing:
        raise UsageError(
            "does not know its clean frames",
            where=capture.root,
            remedy="Only simulated captures do; use --frames perturbed.",
        )
    mended = {side: _mended(hand, truth[side], perturbed) for side, hand in hands.items()}
    return Material(split.train, "clean", "clean_masks", mended)


def _perturbed(capture: Capture) -> np.ndarray:
    """(F,) bool, true where any perturbation acts."""
    acts = np.zeros(len(capture), dtype=bool)
    for name, severities in capture.info.perturbations.items():
        if severities is None:
            raise UsageError(
                f"does not know in which frames {name} acts",
                where=capture.root,
                remedy="Use --frames perturbed.",
            )
        acts |= np.array(severities) > 0
    return acts


def _mended(
    estimate: HandParameters, truth: HandParameters, perturbed: np.ndarray
) -> HandParameters:
    return replace(
        estimate,
        pose=np.where(perturbed[:, None, None], truth.pose, estimate.pose),
        transl=np.where(perturbed[:, None], truth.transl, estimate.transl),
        valid=estimate.valid | (perturbed & truth.valid),
    )
