"""The state of an unfinished fit on disk, so that a stopped one goes on as if it had not been."""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import atomic_write
from wildghand.fitting.optimize import Watchers

#: Version of the file.
SCHEMA = "wildghand-fit/1"
#: Largest file that is read, bytes.
MAX_BYTES = 8 << 30


class Resumable(Protocol):
    """A fit that can be saved and go on: of one capture, or of several at once."""

    #: Where its tensors live.
    device: torch.device

    def state_dict(self) -> dict[str, Any]:
        """Everything that steps change."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        ...


def save_state(
    path: str | os.PathLike[str],
    fit: Resumable,
    watchers: Watchers,
    *,
    step: int,
    seconds: float,
    digest: str,
) -> None:
    """Write everything that changes during a fit.

    Args:
        path: the file; it is replaced whole.
        fit, watchers: the fit and what watches it.
        step: optimizer steps so far.
        seconds: of fitting so far.
        digest: of what is fitted and how; another one is refused when read.
    """
    state = {
        "schema": SCHEMA,
        "digest": digest,
        "step": step,
        "seconds": seconds,
        "fit": fit.state_dict(),
        "watchers": watchers.state_dict(),
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    atomic_write(path, buffer.getvalue())


def load_state(
    path: str | os.PathLike[str],
    fit: Resumable,
    watchers: Watchers,
    digest: str,
) -> tuple[int, float]:
    """Bring a fit back to a saved state; nothing in the file is executed.

    Returns:
        Steps and seconds of fitting behind it.

    Raises:
        BadInput: no such file, damaged, or of another fit.
    """
    file = Path(path)
    if not file.is_file() or file.stat().st_size > MAX_BYTES:
        raise BadInput(f"is missing or larger than {MAX_BYTES} bytes", where=file)
    try:
        state = torch.load(file, map_location=fit.device, weights_only=True)
        if not isinstance(state, Mapping) or state.get("schema") != SCHEMA:
            raise BadInput(f"is not a state of schema {SCHEMA}", where=file)
        _check_digest(state, digest, file)
        fit.load_state_dict(state["fit"])
        watchers.load_state_dict(state["watchers"])
        return int(state["step"]), float(state["seconds"])
    except BadInput:
        raise
    except (
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
        AttributeError,
        KeyError,
        TypeError,
        ValueError,
    ) as error:
        problem = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise BadInput(
            f"is damaged ({problem})", where=file, remedy="Remove it to fit from the start."
        ) from error


def _check_digest(state: Mapping[str, Any], digest: str, file: Path) -> None:
    if state.get("digest") != digest:
        raise BadInput(
            "belongs to another capture, other settings or another seed",
            where=file,
            remedy="Give the same arguments to go on with it, or remove it to start again.",
        )
