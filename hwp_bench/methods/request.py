"""The folder that a method is given: everything it may see of a capture, and nothing more.

A request holds the training and validation frames with their masks, and for every frame,
test frames included, the estimated hand parameters and the cameras. It holds no test pixel, no
truth and no word about the perturbations. Of the free-view clip it holds parameters and cameras.

The frames, masks and hands are the capture's own, or an oracle's choice, which bounds what a
method can reach on a simulated capture: `clean` gives the clean version of every frame,
`unperturbed-only` just those frames that nothing perturbs, and `true:NAMES` replaces single
estimates by the truth, so that an error budget can tell what each of them costs.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import atomic_folder, read_json, write_json
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.base.records import parse_record, unfold, without_schema
from hwp_bench.capture.schema import (
    FREE_VIEW,
    IMAGE_FOLDERS,
    image_path,
    write_numbers,
    write_subject_mesh,
)
from hwp_bench.capture.splits import Split
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.methods.contract import (
    FRAME_CHOICES,
    REQUEST,
    TEMPLATE,
    RequestRecord,
    RunSettings,
    TrainingCapture,
)

if TYPE_CHECKING:
    from hwp_bench.capture import Capture

#: The estimates that the truth can replace, by name, in the order of tables.
ORACLE_INPUTS: Mapping[str, str] = MappingProxyType(
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
#: Version of the request folder.
SCHEMA = "hwp-request/1"


def write_request(path: Path, capture: Capture, split: Split, run: RunSettings) -> Path:
    """Write the part of a capture that a method may see into a folder of its own.

    Images are copied, not linked: a link would lead to the capture, and so to its test frames.
    Settings are tables within tables, however a preset or `--set` names them.
    """
    info = capture.info
    material = choose_training_inputs(capture, split, run.frames)
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
        write_numbers(root, material.hands, capture.cameras)
        mesh = "mesh" in _replaced_by(run.frames)
        if mesh:
            own = {side: capture.true_template(side) for side in info.sides}
            write_subject_mesh(root / TEMPLATE, own)
        clip = capture.free_view
        if clip is not None:
            (root / FREE_VIEW).mkdir()
            hands = choose_free_view_hands(clip, run.frames)
            write_numbers(root / FREE_VIEW, hands, clip.cameras)
        record = RequestRecord(
            id=info.id,
            hands=info.hands,
            width=info.width,
            height=info.height,
            fps=info.fps,
            hand_model=info.hand_model,
            split=split.to_json(),
            settings=unfold(run.settings),
            seed=run.seed,
            budget=run.budget,
            frames=run.frames,
            train=material.train.tolist(),
            free_view=0 if clip is None else len(clip),
            own_template=mesh,
        )
        content = {"schema": SCHEMA, **asdict(record)}
        # What a capture does not have is not said.
        for name in ("free_view", "own_template"):
            if not content[name]:
                del content[name]
        write_json(root / REQUEST, content)
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


# --- the choice of frames, masks and hands


@dataclass(frozen=True, eq=False)
class TrainingInputs:
    """Where the training part of a request comes from."""

    train: np.ndarray
    #: Kind of image that is given as frames, a key of `IMAGE_FOLDERS`.
    frames: str
    #: Kind of image that is given as masks.
    masks: str
    #: Hand parameters by side.
    hands: dict[str, HandParameters]


def frame_choice(truths: Iterable[str]) -> str:
    """The choice of frames in which the truth replaces some estimates."""
    asked = set(truths)
    names = ",".join(name for name in ORACLE_INPUTS if name in asked)
    return _PREFIX + names if names else FRAME_CHOICES[0]


def is_frame_choice(choice: str) -> bool:
    """Whether a choice of frames is one of `FRAME_CHOICES`, or names truths of `ORACLE_INPUTS`."""
    names = _replaced_by(choice)
    return choice in FRAME_CHOICES or (bool(names) and set(names) <= ORACLE_INPUTS.keys())


def known_oracle_inputs(capture: Capture) -> tuple[str, ...]:
    """The estimates of a capture whose truth is stored with it, in the order of `ORACLE_INPUTS`."""
    known = set()
    if capture.true_hands is not None:
        known |= {"poses", "test-poses", "betas"}
    if capture.has_true_masks:
        known.add("masks")
    if capture.has_true_template:
        known.add("mesh")
    if all((capture.root / IMAGE_FOLDERS[kind]).is_dir() for kind in ("clean", "clean_masks")):
        known.add("pixels")
    return tuple(name for name in ORACLE_INPUTS if name in known)


def choose_training_inputs(capture: Capture, split: Split, choice: str) -> TrainingInputs:
    """Return the training part that a method is given of a capture."""
    if choice.startswith(_PREFIX):
        return _with_truths(capture, split, choice)
    if choice not in FRAME_CHOICES:
        raise UsageError(f"{choice!r} is not one of {', '.join(FRAME_CHOICES)}", field="frames")
    hands = dict(capture.hands)
    if choice == "perturbed":
        return TrainingInputs(split.train, "frames", "masks", hands)
    perturbed = _perturbed(capture)
    if choice == "unperturbed-only":
        train = split.train[~perturbed[split.train]]
        if not len(train):
            raise UsageError("has no unperturbed training frame", where=capture.root)
        return TrainingInputs(train, "frames", "masks", hands)
    truth = capture.true_hands
    if truth is None or "pixels" not in known_oracle_inputs(capture):
        raise UsageError(
            "does not know its clean frames",
            where=capture.root,
            remedy="Only simulated captures do; use --train-on perturbed.",
        )
    repaired = {side: _replaced(hand, truth[side], perturbed) for side, hand in hands.items()}
    return TrainingInputs(split.train, "clean", "clean_masks", repaired)


def frames_of_true_poses(split: Split, choice: str) -> np.ndarray:
    """(F,) bool: in which frames a choice of frames replaces poses by the truth, whatever acts."""
    names, rows = _replaced_by(choice), np.zeros(split.frame_count, dtype=bool)
    if "poses" in names:
        rows[split.train] = True
    if "test-poses" in names:
        rows[split.validation] = rows[split.test] = True
    return rows


def choose_free_view_hands(clip: Capture, choice: str) -> dict[str, HandParameters]:
    """Return the hand parameters of a free-view clip that a method is given."""
    truth = clip.true_hands
    # The subject's mesh has the true shape in it, and so belongs in the places of that shape.
    exact = bool({"betas", "mesh"} & set(_replaced_by(choice)))
    return dict(truth if exact and truth is not None else clip.hands)


def _replaced_by(choice: str) -> list[str]:
    """The estimates that a choice of frames replaces by the truth."""
    return choice.removeprefix(_PREFIX).split(",") if choice.startswith(_PREFIX) else []


def _with_truths(capture: Capture, split: Split, choice: str) -> TrainingInputs:
    """The capture with some estimates replaced by the truth."""
    names = _replaced_by(choice)
    known = known_oracle_inputs(capture)
    for name in names:
        if name not in ORACLE_INPUTS:
            raise UsageError(f"{name!r} is not one of {', '.join(ORACLE_INPUTS)}", field="frames")
        if name not in known:
            raise UsageError(
                f"does not know its true {name}",
                where=capture.root,
                remedy="Only simulated captures do.",
            )
    frames, masks = ("clean", "clean_masks") if "pixels" in names else ("frames", "masks")
    if "masks" in names and "pixels" not in names:
        masks = "true_masks"
    rows = frames_of_true_poses(split, choice)
    hands = dict(capture.hands)
    for side, truth in (capture.true_hands or {}).items():
        hands[side] = _replaced(hands[side], truth, rows)
        if "betas" in names:
            hands[side] = replace(hands[side], betas=truth.betas)
    return TrainingInputs(split.train, frames, masks, hands)


def _perturbed(capture: Capture) -> np.ndarray:
    """(F,) bool, true where any perturbation acts."""
    acts = np.zeros(len(capture), dtype=bool)
    for name, severities in capture.info.perturbations.items():
        if severities is None:
            raise UsageError(
                f"does not know in which frames {name} acts",
                where=capture.root,
                remedy="Use --train-on perturbed.",
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
