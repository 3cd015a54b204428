"""The frames, masks and hands that a method is given of a capture: its own, or an oracle's.

Oracles bound what a method can reach on a simulated capture. `clean` gives the clean version of
every frame, `unperturbed-only` just those frames that nothing perturbs. `true:NAMES` replaces
single estimates by the truth, so that an error budget can tell what each of them costs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.capture.schema import IMAGE_FOLDERS
from hwp_bench.capture.splits import Split
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.methods.contract import FRAME_CHOICES

if TYPE_CHECKING:
    from hwp_bench.capture import Capture

#: The estimates that the truth can replace, by name, in the order of tables.
TRUTHS: Mapping[str, str] = MappingProxyType(
    {
        "pixels": "clean versions of the training frames, with their masks",
        "masks": "exact masks of the visible hand in the training frames",
        "poses": "pose and translation in the training frames",
        "test-poses": "pose and translation in the frames that are rendered",
        "betas": "shape parameters",
        "mesh": "the subject's own rest mesh and joints, in place of the hand model's template",
    }
)
_PREFIX = "true:"


@dataclass(frozen=True, eq=False)
class TrainingMaterial:
    """Where the training part of a request comes from."""

    #: Indices of the training frames.
    train: np.ndarray
    #: Kind of image that is given as frames, a key of `IMAGE_FOLDERS`.
    frames: str
    #: Kind of image that is given as masks.
    masks: str
    #: Hand parameters by side.
    hands: dict[str, HandParameters]


def frames_with(truths: Iterable[str]) -> str:
    """The choice of frames in which the truth replaces some estimates.

    Args:
        truths: names in `TRUTHS`; none of them means the capture as it is.
    """
    asked = set(truths)
    return _PREFIX + ",".join(name for name in TRUTHS if name in asked) if asked else "perturbed"


def known_truths(capture: Capture) -> tuple[str, ...]:
    """The estimates of a capture whose truth is stored with it, in the order of `TRUTHS`."""
    known = set()
    if capture.true_hands is not None:
        known |= {"poses", "test-poses", "betas"}
    if capture.has_true_masks:
        known.add("masks")
    if capture.has_true_template:
        known.add("mesh")
    if all((capture.root / IMAGE_FOLDERS[kind]).is_dir() for kind in ("clean", "clean_masks")):
        known.add("pixels")
    return tuple(name for name in TRUTHS if name in known)


def training_material(capture: Capture, split: Split, choice: str) -> TrainingMaterial:
    """Return the training part that a method is given of a capture.

    Args:
        capture: the capture.
        split: its split.
        choice: one of `FRAME_CHOICES`, or what `frames_with` returned. `clean` gives, besides
            clean frames and their masks, the true hand parameters in perturbed frames: an
            estimator would not have been misled.

    Raises:
        UsageError: there is no such choice, or the capture does not know its clean frames or
            severities, or another truth that is asked for, or every training frame is perturbed.
    """
    if choice.startswith(_PREFIX):
        return _with_truths(capture, split, _replaced_by(choice))
    if choice not in FRAME_CHOICES:
        raise UsageError(f"{choice!r} is not one of {', '.join(FRAME_CHOICES)}", field="frames")
    hands = dict(capture.hands)
    if choice == "perturbed":
        return TrainingMaterial(split.train, "frames", "masks", hands)
    perturbed = _perturbed(capture)
    if choice == "unperturbed-only":
        train = split.train[~perturbed[split.train]]
        if not len(train):
            raise UsageError("has no unperturbed training frame", where=capture.root)
        return TrainingMaterial(train, "frames", "masks", hands)
    truth = capture.true_hands
    if truth is None or "pixels" not in known_truths(capture):
        raise UsageError(
            "does not know its clean frames",
            where=capture.root,
            remedy="Only simulated captures do; use --frames perturbed.",
        )
    repaired = {side: _replaced(hand, truth[side], perturbed) for side, hand in hands.items()}
    return TrainingMaterial(split.train, "clean", "clean_masks", repaired)


def free_view_hands(clip: Capture, choice: str) -> dict[str, HandParameters]:
    """Return the hand parameters of a free-view clip that a method is given.

    Args:
        clip: the clip.
        choice: as in `training_material`; angles and places are true in every case, betas are
            those of the training frames.
    """
    truth = clip.true_hands
    # The subject's mesh has the true shape in it, and so belongs in the places of that shape.
    exact = bool({"betas", "mesh"} & set(_replaced_by(choice)))
    return dict(truth if exact and truth is not None else clip.hands)


def gives_mesh(choice: str) -> bool:
    """Whether a choice of frames replaces the template by the subject's own mesh."""
    return "mesh" in _replaced_by(choice)


def _replaced_by(choice: str) -> list[str]:
    """The estimates that a choice of frames replaces by the truth."""
    return choice.removeprefix(_PREFIX).split(",") if choice.startswith(_PREFIX) else []


def _with_truths(capture: Capture, split: Split, names: list[str]) -> TrainingMaterial:
    """The capture as it is, but for some estimates."""
    known = known_truths(capture)
    for name in names:
        if name not in TRUTHS:
            raise UsageError(f"{name!r} is not one of {', '.join(TRUTHS)}", field="frames")
        if name not in known:
            raise UsageError(
                f"does not know its true {name}",
                where=capture.root,
                remedy="Only simulated captures do.",
            )
    frames, masks = ("clean", "clean_masks") if "pixels" in names else ("frames", "masks")
    if "masks" in names and "pixels" not in names:
        masks = "true_masks"
    rows = np.zeros(len(capture), dtype=bool)
    if "poses" in names:
        rows[split.train] = True
    if "test-poses" in names:
        rows[split.validation] = rows[split.test] = True
    hands = dict(capture.hands)
    for side, truth in (capture.true_hands or {}).items():
        hands[side] = _replaced(hands[side], truth, rows)
        if "betas" in names:
            hands[side] = replace(hands[side], betas=truth.betas)
    return TrainingMaterial(split.train, frames, masks, hands)


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


def _replaced(estimate: HandParameters, truth: HandParameters, rows: np.ndarray) -> HandParameters:
    """The estimate with the truth's pose and translation in some frames, (F,) bool."""
    return replace(
        estimate,
        pose=np.where(rows[:, None, None], truth.pose, estimate.pose),
        transl=np.where(rows[:, None], truth.transl, estimate.transl),
        valid=estimate.valid | (rows & truth.valid),
    )
