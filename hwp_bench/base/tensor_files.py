"""Tables of tensors from files of a person's: safetensors, or what `torch.save` writes."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import check_is_file

if TYPE_CHECKING:
    from torch import Tensor


def read_tensors(path: str | os.PathLike[str], max_bytes: int) -> dict[str, Tensor]:
    """Read tensors by name; nothing else that a file may hold is made or run.

    Args:
        path: a `.safetensors` file, or a checkpoint of torch, in its present format (then tensors
            stay on the disk until they are used) or its former one.
        max_bytes: largest file that is read.

    Raises:
        BadInput: it is missing, larger, cannot be read, or is not a table of tensors.
    """
    import torch

    file = Path(path)
    check_is_file(file)
    if file.stat().st_size > max_bytes:
        raise BadInput(f"is larger than {max_bytes} bytes", where=file)
    try:
        if file.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(file)
        mapped = zipfile.is_zipfile(file)
        loaded = torch.load(file, map_location="cpu", weights_only=True, mmap=mapped)
    # A damaged file may raise anything in its reader.
    except Exception as error:
        text = (str(error).splitlines() or [""])[0][:200]
        raise BadInput(f"cannot be read ({type(error).__name__}: {text})", where=file) from error
    if not isinstance(loaded, dict) or not all(isinstance(name, str) for name in loaded):
        raise BadInput("is not a table of parameters", where=file)
    return {name: value for name, value in loaded.items() if isinstance(value, torch.Tensor)}
