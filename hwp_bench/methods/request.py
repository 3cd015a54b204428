"""The folder that a method is given: everything it may see of a capture, and nothing more.

A request holds the training and validation frames with their masks, and for every frame,
test frames included, the estimated hand parameters and the cameras. It holds no test pixel, no
truth and no word about the perturbations.

The frames are those that were captured, or an oracle's choice of them. The oracles bound what any
method can reach on a simulated capture: the same fit on the clean version of every frame, and the
same fit on only those frames that nothing perturbs.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import atomic_folder, read_json, write_json
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.base.records import parse_record, without_schema
from hwp_bench.capture.schema import CAMERAS, HANDS, IMAGE_FOLDERS, image_path
from hwp_bench.capture.splits import Split
from hwp_bench.capture.tracks import write_cameras, write_hands
from hwp_bench.hands.parameters import HandParameters
from hwp_bench.methods.contract import (
    FRAME_CHOICES,
    REQUEST,
    RequestRecord,
    RunSettings,
    TrainingCapture,
)

if TYPE_CHECKING:
    from hwp_bench.capture import Capture

#: Version of the request folder.
SCHEMA = "hwp-request/1"


def write_request(path: Path, capture: Capture, split: Split, run: RunSettings) -> Path:
    """Write the part of a capture that a method may see into a folder of its own.

    Images are copied, not linked: a link would lead to the capture, and so to its test frames.

    Raises:
        BadImage: a training or validation image is missing or damaged.
        UsageError: the capture does not know what `run.frames` asks for.
    """
    info = capture.info
    material = training_material(capture, split, run.frames)
    with atomic_folder(path, overwrite=True) as root:
        for frame in [*material.train.tolist(), *split.validation.tolist()]:
            for kind, source_kind, read in (
                ("frames", material.frames, read_rgb),
                ("masks", material.masks, read_gray),
            ):
                source = image_path(capture.root, source_kind, frame)
                # Reading first names a damaged image here, before a method stumbles over it.
                read(source, capture.size)
                target = image_path(root, kind, frame)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)
        write_hands(root / HANDS, material.hands)
        write_cameras(root / CAMERAS, capture.cameras)
        description = {
            "schema": SCHEMA,
            "id": info.id,
            "hands": info.hands,
            "width": info.width,
            "height": info.height,
            "fps": info.fps,
            "hand_model": info.to_json()["hand_model"],
            "split": split.to_json(),
            "settings": dict(run.settings),
            "seed": run.seed,
            "budget": {"seconds": run.budget.seconds, "steps": run.budget.steps},
            "frames": run.frames,
            "train": material.train.tolist(),
        }
        write_json(root / REQUEST, description)
    return path


def open_request(path: str | os.PathLike[str]) -> TrainingCapture:
    """Open a request folder.

    Raises:
        BadInput: it is not a request of this version, or damaged.
    """
    root = Path(path)
    where = root / REQUEST
    value = without_schema(read_json(where), SCHEMA, where=where, error=BadInput)
    return TrainingCapture(root, parse_record(RequestRecord, value, where=where, error=BadInput))


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


def training_material(capture: Capture, split: Split, choice: str) -> TrainingMaterial:
    """Return the training part that a method is given of a capture.

    Args:
        capture: the capture.
        split: its split.
        choice: one of `FRAME_CHOICES`. `clean` gives, besides clean frames and their masks, the
            true hand parameters in perturbed frames: an estimator would not have been misled.

    Raises:
        UsageError: there is no such choice, or the capture does not know its clean frames or
            severities, or every training frame is perturbed.
    """
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
    repaired = {side: _repaired(hand, truth[side], perturbed) for side, hand in hands.items()}
    return TrainingMaterial(split.train, "clean", "clean_masks", repaired)


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


def _repaired(
    estimate: HandParameters, truth: HandParameters, perturbed: np.ndarray
) -> HandParameters:
    return replace(
        estimate,
        pose=np.where(perturbed[:, None, None], truth.pose, estimate.pose),
        transl=np.where(perturbed[:, None], truth.transl, estimate.transl),
        valid=estimate.valid | (perturbed & truth.valid),
    )
