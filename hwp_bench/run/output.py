"""The output folder of a run: the names in it, and the facts that `run.json` holds.

The worker writes it for a Python method; a command may write the same files.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from hwp_bench.base.files import read_json
from hwp_bench.base.records import Count, Line, Seconds, parse_record

#: Folder of the predicted test frames inside the output folder.
PREDICTIONS = "predictions"
#: Folder of the predicted frames of the free-view clip inside the output folder.
FREE_VIEW = "free"
#: Folder of the validation frames of each checkpoint inside the output folder.
CHECKPOINTS = "checkpoints"
#: Folder of files that a method writes about itself, for pictures and tables; optional.
DIAGNOSTICS = "diagnostics"
#: Time, steps and memory of the run.
RUN = "run.json"
#: How far the fit is.
PROGRESS = "progress.json"
#: Why the run failed.
FAILURE = "failure.json"
#: The method's printed output.
LOG = "log.txt"
#: Settings and seed of a method that is only made, in the place of a request.
REHEARSAL = "rehearsal.json"
#: Largest `run.json` that is read, bytes; most frames and checkpoints in it.
MAX_BYTES = 1024 * 1024
MAX_FRAMES, MAX_CHECKPOINTS = 64, 1000


@dataclass(frozen=True)
class Checkpoint:
    """One recorded moment of a fit."""

    #: Optimizer steps done.
    step: Count
    #: Seconds on the method's clock.
    seconds: Seconds
    #: Peak memory of the process until then, bytes.
    peak_memory: Count


@dataclass(frozen=True)
class RunFacts:
    """Time, steps and memory of a run; None where the method does not say."""

    #: Seconds on the method's clock.
    fit_seconds: Seconds | None = None
    #: CPU seconds of the process and its children on that clock, all threads added up.
    cpu_seconds: Seconds | None = None
    #: Seconds before that clock started, in which the method was made: what it compiles or loads.
    ready_seconds: Seconds | None = None
    #: Seconds to render the test frames.
    render_seconds: Seconds | None = None
    #: Seconds spent on checkpoints, outside the method's clock.
    curve_seconds: Seconds | None = None
    #: Optimizer steps.
    steps: Count | None = None
    #: Peak memory of the process, bytes.
    peak_memory: Count | None = None
    #: Device that the method ran on.
    device: Line | None = None
    #: Validation frames that were rendered for every checkpoint.
    checkpoint_frames: Annotated[list[Count], Meta(max_length=MAX_FRAMES)] = field(
        default_factory=list
    )
    #: The checkpoints, in time order; the last is the finished fit.
    checkpoints: Annotated[list[Checkpoint], Meta(max_length=MAX_CHECKPOINTS)] = field(
        default_factory=list
    )


def checkpoint_folder(output: Path, index: int) -> Path:
    """Return the folder of the validation frames of a checkpoint."""
    return output / CHECKPOINTS / f"{index:03d}"


def read_facts(path: Path) -> RunFacts:
    """Read `run.json`; a run need not write one.

    Raises:
        BadInput: it is damaged.
        BadResult: a field is unknown or of the wrong type.
    """
    if not path.is_file():
        return RunFacts()
    return parse_record(RunFacts, read_json(path, max_bytes=MAX_BYTES), where=str(path))
