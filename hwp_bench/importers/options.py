"""What a person may choose when a video becomes a capture."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from hwp_bench.base.errors import UsageError
from hwp_bench.importers.decode import FrameRange
from hwp_bench.importers.fit_settings import FitSettings


@dataclass(frozen=True)
class VideoImport:
    """Choices of a video import; checked when made.

    Raises:
        UsageError: a choice makes no sense; it names the option.
    """

    #: Which hand is in the picture: `right` or `left`.
    hand: str = "right"
    #: Focal length in px of the whole frame, or None to estimate it.
    focal: float | None = None
    #: Folder with masks of the user's own, or None to cut them out.
    masks: Path | None = None
    #: Edge of the stored square frames, px.
    size: int = 256
    #: Which frames to take.
    frames: FrameRange = field(default_factory=FrameRange)
    #: Id of the capture, or None for the name of the output folder.
    id: str | None = None
    #: What the hand does.
    action: str = "unknown"
    #: What recorded the video.
    device: str = "unknown"
    #: Terms under which the frames may be used.
    licence: str = "unknown"
    #: Perturbations that the user says are in the clip; how severe in which frame is unknown.
    perturbations: tuple[str, ...] = ()
    #: Hand model, as `load_template` takes it.
    hand_model: str = "anny"
    #: Frames whose tracker score is lower count as not detected.
    min_score: float = 0.5
    #: Further place for the overlay sheet, or None.
    sheet: Path | None = None
    #: Replace an existing capture.
    overwrite: bool = False
    #: Numbers of the fit.
    fit: FitSettings = field(default_factory=FitSettings)

    def __post_init__(self) -> None:
        rules = (
            ("--hand", self.hand in ("right", "left"), "must be right or left"),
            ("--focal", self.focal is None or 1 <= self.focal <= 1e6, "must be 1 to 1e6 px"),
            ("--size", 32 <= self.size <= 2048, "must be 32 to 2048 px"),
            ("--min-score", 0 <= self.min_score <= 1, "must be in [0, 1]"),
            ("--licence", bool(self.licence), "must not be empty"),
        )
        for option, good, problem in rules:
            if not good:
                raise UsageError(problem, field=option)

    def capture_id(self, out: str | os.PathLike[str]) -> str:
        """Return the id of the capture that is written to `out`."""
        return self.id or Path(out).absolute().name
