"""The tensors of an avatar from a file, compared with its description before memory is taken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from hwp_bench.base.errors import BadInput
from hwp_bench.base.text import shown
from wildghand.model.settings import WildGHandSettings
from wildghand.network.network import MAPS, shapes_of_settings

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
    """Read the tensors of an avatar.

    Args:
        file: a safetensors file.
        settings: those that the avatar's description states.
        sides: its hands.
        frame_count: its training frames.
        declared: names of all tensors; None: the description does not say.

    Raises:
        BadInput: the file is missing, too large or damaged, or a tensor is missing, not declared,
            of integers, not finite, out of range, or has another shape than the description says;
            the tensor is named.
    """
    from safetensors import SafetensorError, safe_open

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
                _check_part(name, part.get_shape(), str(part.get_dtype()), expected, file)
            for name in sorted((expected.keys() | set(declared or ())) - set(names)):
                raise BadInput(
                    "is missing", where=file, field=shown(name)[:100], remedy=_ANOTHER_COPY
                )
            for name in sorted(set(names) - set(names if declared is None else declared)):
                raise BadInput(
                    "is not among the tensors that its description names",
                    where=file,
                    field=shown(name)[:100],
                    remedy=_ANOTHER_COPY,
                )
            tensors = {name: stored.get_tensor(name) for name in names}
    except (SafetensorError, RuntimeError, OSError, ValueError, AssertionError) as error:
        problem = (str(error).splitlines() or [type(error).__name__])[0][:300]
        raise BadInput(f"does not hold this avatar's tensors ({problem})", where=file) from error
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise BadInput("holds NaN or infinity", where=file, field=shown(name)[:100])
        if tensor.numel() and float(tensor.abs().max()) > LARGEST:
            raise BadInput(
                f"holds a number beyond {LARGEST:g}",
                where=file,
                field=shown(name)[:100],
                remedy=_ANOTHER_COPY,
            )
    return tensors


def _check_part(
    name: str, shape: Sequence[int], kind: str, expected: dict[str, tuple[int, ...]], file: Path
) -> None:
    field = shown(name)[:100]
    if kind not in _FLOATS:
        raise BadInput(f"holds {kind}, not floating point", where=file, field=field)
    if name in expected and tuple(shape) != expected[name]:
        raise BadInput(
            f"is {tuple(shape)}, not {expected[name]} as its description says"[:200],
            where=file,
            field=field,
        )


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
    for name, shape in shapes_of_settings(settings.network).items():
        if name not in absent:
            shapes[f"network.{name}"] = tuple(shape)
    return shapes
