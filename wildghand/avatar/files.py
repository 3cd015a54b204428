"""An avatar as a folder: safetensors, JSON and images, without the training data.

avatar.json           what it is, of which hand model, how it was fitted
model.safetensors     every tensor of the model
weights/000012.png    weight mask of a training frame, to look at
call.json             digest of the call that made it, where one call made it of a capture

Tensors are compared with the description before memory is taken.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta

from hwp_bench.base.errors import BadInput, HwpError, place, shown
from hwp_bench.base.files import atomic_folder, read_json, refuse_other, write_json
from hwp_bench.base.images import read_gray, write_image
from hwp_bench.base.records import Seed, parse_record
from hwp_bench.capture.schema import SIDES, HandModelId
from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.hands.sources import absolute_source
from wildghand.avatar.avatar import FitRecord, WildGHandAvatar
from wildghand.model.model import make_model
from wildghand.model.settings import WildGHandSettings, read_settings
from wildghand.network.network import MAPS, shapes_of_settings
from wildghand.subject import SubjectShape

#: Largest model that is read, bytes.
MAX_MODEL_BYTES = 4 << 30
#: Most tensors of a model.
MAX_TENSORS = 10_000

#: Largest number of a tensor that is read; those of fits lie far below.
LARGEST = 1e6

_ANOTHER_COPY = "The avatar is damaged: take another copy, or fit it again."
_FLOATS = ("F16", "BF16", "F32", "F64")


def read_tensors(
    file: Path,
    settings: WildGHandSettings,
    sides: Sequence[str],
    frame_count: int,
    declared: Sequence[str] | None = None,
) -> dict[str, torch.Tensor]:
    """Read the tensors of an avatar; `declared` are their names, if the description says them."""
    from safetensors import SafetensorError, safe_open

    def refuse(problem: str, name: str, remedy: str | None = None) -> BadInput:
        return BadInput(problem, where=file, field=shown(name)[:100], remedy=remedy)

    if not file.is_file() or file.stat().st_size > MAX_MODEL_BYTES:
        raise BadInput(f"is missing or larger than {MAX_MODEL_BYTES} bytes", where=file)
    try:
        expected = _shapes(settings, sides, frame_count)
        with safe_open(file, "pt") as stored:
            names = list(stored.keys())
            if len(names) > MAX_TENSORS:
                raise BadInput(f"holds more than {MAX_TENSORS:,} tensors", where=file)
            for name in names:
                part = stored.get_slice(name)
                kind, shape = str(part.get_dtype()), tuple(part.get_shape())
                if kind not in _FLOATS:
                    raise refuse(f"holds {kind}, not floating point", name)
                if shape != expected.get(name, shape):
                    problem = f"is {shape}, not {expected[name]} as its description says"
                    raise refuse(problem[:200], name)
            for name in sorted((expected.keys() | set(declared or ())) - set(names)):
                raise refuse("is missing", name, _ANOTHER_COPY)
            for name in sorted(set(names) - set(names if declared is None else declared)):
                problem = "is not among the tensors that its description names"
                raise refuse(problem, name, _ANOTHER_COPY)
            tensors = {name: stored.get_tensor(name) for name in names}
    except (SafetensorError, RuntimeError, OSError, ValueError, AssertionError) as error:
        problem = (str(error).splitlines() or [type(error).__name__])[0][:300]
        raise BadInput(f"does not hold this avatar's tensors ({problem})", where=file) from error
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise refuse("holds NaN or infinity", name)
        if tensor.numel() and float(tensor.abs().max()) > LARGEST:
            raise refuse(f"holds a number beyond {LARGEST:g}", name, _ANOTHER_COPY)
    return tensors


def _shapes(
    settings: WildGHandSettings, sides: Sequence[str], frame_count: int
) -> dict[str, tuple[int, ...]]:
    """Shapes of the tensors whose size the description states, without memory for any."""
    shapes = {
        "log_gains": (frame_count, 3),
        "pose_steps": (len(sides), frame_count, 16, 3),
        "transl_steps": (len(sides), frame_count, 3),
    }
    absent = {f"{MAPS}{side}" for side in ("right", "left") if side not in sides}
    for name, shape in shapes_of_settings(settings.network.build()).items():
        if name not in absent:
            shapes[f"network.{name}"] = tuple(shape)
    return shapes


# More than any fit writes.
_MOST = 1000


def write_weight_masks(avatar: WildGHandAvatar, folder: Path) -> None:
    """Write the weight masks that the avatar knows as images, named by frame."""
    for frame, mask in sorted(avatar.weight_masks.items()):
        write_image(folder / f"{frame:06d}.png", mask)


def read_weight_masks(folder: Path, frames: list[int]) -> dict[int, np.ndarray]:
    """Read the weight masks of frames that an avatar was fitted to: (H, W) uint8 by frame."""
    there = sorted(path.name for path in folder.glob("*.png"))[:_MOST]
    names = {frame: f"{frame:06d}.png" for frame in frames}
    return {frame: read_gray(folder / name) for frame, name in names.items() if name in there}


#: Version of the folder.
SCHEMA = "wildghand-avatar/3"
#: Names of its files.
DESCRIPTION = "avatar.json"
MODEL = "model.safetensors"
WEIGHTS = "weights"
CALL = "call.json"
#: Largest description that is read, bytes: that of a fit of 100,000 frames has 10 million.
MAX_DESCRIPTION_BYTES = 32 << 20
#: Largest shape parameter that is read, standard deviations; people lie within 5.
MAX_BETA = 100.0


@dataclasses.dataclass(frozen=True)
class _Description:
    """The content of `avatar.json`."""

    schema: str
    hand_model: HandModelId
    sides: Annotated[list[str], Meta(max_length=2)]
    seed: Seed
    mean_color: Annotated[list[float], Meta(max_length=3)]
    betas: dict[str, list[float]]
    settings: dict[str, Any]
    fit: FitRecord
    #: Names of the tensors of `model.safetensors`; None in avatars that do not say.
    tensors: (
        Annotated[list[Annotated[str, Meta(max_length=200)]], Meta(max_length=MAX_TENSORS)] | None
    ) = None


def refuse_no_avatar(path: str | os.PathLike[str]) -> None:
    """Refuse the place of an avatar where something else is, or next to one in its folder."""

    def is_avatar(folder: Path) -> bool:
        names = {item.name for item in folder.iterdir()}
        return DESCRIPTION in names <= {DESCRIPTION, MODEL, WEIGHTS, CALL}

    refuse_other(path, "an avatar", is_avatar)


def save_avatar(
    avatar: WildGHandAvatar,
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    call: str | None = None,
) -> Path:
    """Write an avatar folder, whole or not at all.

    Args:
        avatar: the avatar.
        path: the folder to make.
        overwrite: replace an existing avatar.
        call: digest of the call that makes it, by which a second one knows that it is complete.

    Raises:
        UsageError: something is there and may not be replaced.
    """
    from safetensors.torch import save

    tensors = avatar.model.state_dict()
    description = _Description(
        schema=SCHEMA,
        hand_model=avatar.hand_model,
        sides=list(avatar.sides),
        seed=avatar.seed,
        mean_color=[float(value) for value in avatar.mean_color],
        betas={side: [float(b) for b in betas] for side, betas in avatar.betas.items()},
        settings=dataclasses.asdict(avatar.settings),
        fit=avatar.record,
        tensors=sorted(tensors),
    )
    refuse_no_avatar(path)
    with atomic_folder(path, overwrite=overwrite, flag="--overwrite") as folder:
        # Not `save_file`, which makes a file that only its owner may read.
        data = save({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
        (folder / MODEL).write_bytes(data)
        write_json(folder / DESCRIPTION, dataclasses.asdict(description))
        write_weight_masks(avatar, folder / WEIGHTS)
        if call is not None:
            write_json(folder / CALL, {"call": call})
    avatar.folder = Path(path)
    return avatar.folder


def made_by_call(path: Path, call: str) -> bool:
    """Whether a folder is the avatar that a call has made, by the digest of the call."""
    with contextlib.suppress(BadInput):
        made = read_json(path / CALL, max_bytes=1000) == {"call": call}
        return made and (path / DESCRIPTION).is_file()
    return False


def load_avatar(
    path: str | os.PathLike[str],
    *,
    device: torch.device | str = "cpu",
    hand: str | None = None,
) -> WildGHandAvatar:
    """Read an avatar folder; nothing in it is executed.

    Args:
        path: the folder.
        device: where it will be drawn.
        hand: source of the hand model (`anny`, `mano:PATH`); None takes the one that the avatar
            names.

    Raises:
        BadInput: no avatar, damaged, or made with another hand model; the field is named.
    """
    root = place(path, "path")
    if not (root / DESCRIPTION).is_file():
        raise BadInput(
            f"is not an avatar: it has no {DESCRIPTION}",
            where=root,
            remedy="Make one with `wildghand fit CAPTURE -o AVATAR`.",
        )
    where = str(root / DESCRIPTION)
    description = read_json(root / DESCRIPTION, max_bytes=MAX_DESCRIPTION_BYTES)
    value = parse_record(_Description, description, where=where, error=BadInput)
    try:
        if value.schema != SCHEMA:
            raise BadInput(
                f"is {value.schema[:40]!r} where {SCHEMA!r} is read",
                field="schema",
                remedy="Fit the avatar again.",
            )
        settings = read_settings(value.settings)
        _check_description(value)
    except HwpError as error:
        raise BadInput(str(error), where=where) from error
    templates = _templates(value.hand_model, value.sides, hand, where)
    mean_color, frame_count = torch.tensor(value.mean_color), max(1, len(value.fit.frames))
    device = torch.device(device)
    file = root / MODEL
    tensors = read_tensors(file, settings, value.sides, frame_count, value.tensors)
    try:
        vertices = len(next(iter(templates.values())).vertices)
        subject = SubjectShape.from_tensors(tensors, str(file), V=vertices)
        model = make_model(
            templates, settings, mean_color, frame_count, value.seed, device, subject
        )
        model.keep_all(tensors, str(file))
        model.load_state_dict(tensors, strict=True)
    except RuntimeError as error:
        problem = str(error).splitlines()[0][:300]
        raise BadInput(f"does not hold this avatar's tensors ({problem})", where=file) from error
    betas = {side: np.array(given) for side, given in value.betas.items()}
    # What draws the avatar loads the hand model again.
    source = absolute_source(hand or value.hand_model.source)
    hand_model = dataclasses.replace(value.hand_model, source=source)
    avatar = WildGHandAvatar(
        model.eval(),
        settings,
        hand_model,
        betas,
        mean_color,
        value.seed,
        value.fit,
        functools.partial(read_weight_masks, root / WEIGHTS, value.fit.frames),
    )
    avatar.folder = root
    return avatar


def _check_description(value: _Description) -> None:
    if tuple(value.sides) not in SIDES.values():
        raise BadInput(f"are {value.sides}"[:200], field="sides")
    if len(value.mean_color) != 3 or not all(0.0 <= part <= 1.0 for part in value.mean_color):
        raise BadInput("must be three numbers in [0, 1]", field="mean_color")
    for side in value.sides:
        betas = value.betas.get(side, [])
        if len(betas) != 10 or not all(abs(each) <= MAX_BETA for each in betas):
            raise BadInput(
                f"must be ten numbers from -{MAX_BETA:g} to {MAX_BETA:g} for each hand",
                field=f"betas.{side}",
                remedy=_ANOTHER_COPY,
            )
    _check_record(value.fit, value.sides)


def _check_record(fit: FitRecord, sides: Sequence[str]) -> None:
    """Check that what is said of the fitted frames is said of each of them, once."""
    others = sorted(fit.temporal.keys() - set(sides))
    if others:
        problem = f"names {shown(others[0])[:40]!r}, which is not a hand of the avatar"
        raise BadInput(problem, field="fit.temporal", remedy=_ANOTHER_COPY)
    count = len(fit.frames)
    if len(set(fit.frames)) < count:
        raise BadInput("names a frame twice", field="fit.frames", remedy=_ANOTHER_COPY)
    lengths = {f"temporal.{side}": len(values) for side, values in fit.temporal.items()}
    # These may be empty.
    lengths["clean"] = len(fit.clean) or count
    lengths["frame_weights"] = len(fit.frame_weights) or count
    for name, length in lengths.items():
        if length != count:
            problem = f"has {length} numbers where {count} frames were fitted"
            raise BadInput(problem, field=f"fit.{name}", remedy=_ANOTHER_COPY)


def _templates(
    hand_model: HandModelId, sides: list[str], hand: str | None, where: str
) -> dict[str, HandTemplate]:
    templates = {side: load_template(hand or hand_model.source, side) for side in sides}
    found = next(iter(templates.values()))
    problem = ""
    if found.name != hand_model.name:
        problem = f"was made with the hand model {hand_model.name}, not {found.name}"
        remedy = f"Give the model it was made with: --hand-model {hand_model.source}."
    # The same surface from another file is the same model; of another edition every vertex differs.
    elif found.digest != hand_model.digest:
        problem = (
            f"was made with another edition of the hand model {found.name} "
            f"({hand_model.digest[:12]}) than the one here ({found.digest[:12]})"
        )
        remedy = "Give the edition it was made with (--hand-model), or fit the avatar again."
    if problem:
        raise BadInput(problem, where=where, field="hand_model", remedy=remedy)
    return templates
