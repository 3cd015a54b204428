"""The records of a result file, and what is read off them.

A field that was added within a version has a default, which says what files without it mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import canonical_json
from hwp_bench.base.records import Count, Line, Message, Seconds, Seed
from hwp_bench.metrics.score import CaptureScores, Scores, aggregate
from hwp_bench.results.bounds import (
    MAX_CAPTURES,
    MAX_CURVE,
    MAX_FRAMES,
    FreeTable,
    Limits,
    ScoreTable,
    check_scores,
    check_table,
)

# Longest text of a setting's value.
_SHOWN = 40


@dataclass(frozen=True)
class FrameResult:
    """The scores of one test frame."""

    #: Index in the capture.
    frame: Annotated[int, Meta(ge=0, lt=MAX_FRAMES)]
    #: Score by metric; a failed frame has the declared penalties.
    scores: ScoreTable
    #: Why the frame could not be scored, or None.
    failure: Message | None

    def __post_init__(self) -> None:
        check_scores(self.scores)


@dataclass(frozen=True)
class CurvePoint:
    """The state of a fit at one checkpoint."""

    #: Optimizer steps done.
    step: Count
    #: Seconds on the method's clock.
    seconds: Seconds
    #: Peak memory of the method's process until then, bytes.
    peak_memory: Count
    #: Mean score over the validation frames that were rendered.
    scores: ScoreTable

    def __post_init__(self) -> None:
        check_scores(self.scores)


@dataclass(frozen=True)
class FreeViewResult:
    """The scores of the free-view clip of a capture, apart from those of its test frames."""

    #: Digest of the clip.
    digest: Line
    #: Every frame of the clip, in order.
    frames: Annotated[list[FrameResult], Meta(max_length=MAX_FRAMES)]
    #: SHA-256 over the decoded pixels of the predictions, in frame order.
    predictions_digest: Line


@dataclass(frozen=True)
class CaptureResult:
    """One method on one capture."""

    #: Id of the capture.
    id: Line
    #: Digest of the capture.
    digest: Line
    #: `right`, `left` or `both`.
    hands: str = field(metadata={"choices": ("right", "left", "both")})
    #: Names of the perturbations that it declares.
    perturbations: Annotated[list[Line], Meta(max_length=20)]
    #: Digest of the split.
    split_digest: Line
    #: True where the scoring masks are exact coverage, False where they are estimates.
    exact_masks: bool
    #: Digest of everything that decides the scores; equal keys need no second run.
    key: Line
    #: Every frame that the split lists, in order.
    frames: Annotated[list[FrameResult], Meta(max_length=MAX_FRAMES)]
    #: Why the method failed on the whole capture, or None.
    failure: Message | None
    #: SHA-256 over the decoded pixels of the predictions, in frame order.
    predictions_digest: Line
    #: Seconds on the method's clock.
    fit_seconds: Seconds | None
    #: Seconds to render the test frames.
    render_seconds: Seconds | None
    #: Seconds to score them.
    score_seconds: Seconds
    #: Seconds of the method's process from start to end.
    wall_seconds: Seconds
    #: Optimizer steps.
    steps: Count | None
    #: Peak memory of the method's process, bytes.
    peak_memory: Count | None
    #: Device that the method says it ran on.
    device: Line | None
    #: Validation scores over time.
    curve: Annotated[list[CurvePoint], Meta(max_length=MAX_CURVE)]
    #: Seconds that the method's process spent on checkpoints, outside the method's clock.
    curve_seconds: Seconds | None = None
    #: Seconds of everything: reading, copying, the method's process, scoring, images.
    job_seconds: Seconds | None = None
    #: CPU seconds of the method's process on its clock, all threads added up: the seconds that
    #: the fit would take on one core. None where it was not recorded.
    cpu_seconds: Seconds | None = None
    #: How the method's process was isolated: `namespaces`, or `processes` with the reason why
    #: not more; None for predictions that came as files, and where it was not recorded.
    isolation: Line | None = None
    #: Scores of the free-view clip; None where the capture has none, or the method drew none.
    free_view: FreeViewResult | None = None
    #: Importer and version that made the hand parameters and masks, such as `video 2`; None where
    #: the capture does not say so (simulated ones do not), and where it was not recorded.
    made_by: Line | None = None
    #: Digest of the files that the method was shown next to its request (`--expose`, settings that
    #: name files), a part of `key`; None where there were none, and where it was not recorded.
    exposed: Line | None = None

    def __post_init__(self) -> None:
        if len({frame.frame for frame in self.frames}) != len(self.frames):
            raise UsageError("holds a frame twice", field="frames")

    @property
    def failed_frames(self) -> int:
        """How many frames could not be scored."""
        return sum(frame.failure is not None for frame in self.frames)


@dataclass(frozen=True)
class MethodId:
    """Which method, in which state."""

    #: Short name.
    name: Line
    #: Name in tables.
    title: Line
    #: Digest of the method directory's text files.
    digest: Line
    #: Preset that was asked for, `default` if none.
    preset: Line
    #: The settings that it was run with.
    settings: FreeTable

    def __post_init__(self) -> None:
        check_table(self.settings, "settings")


@dataclass(frozen=True, repr=False)
class Results:
    """One evaluation: a method on a set of captures."""

    #: The method.
    method: MethodId
    #: Name of the suite, or `captures` when captures were named one by one.
    suite: Line
    #: Seed of everything random.
    seed: Seed
    #: Limits of the fit: `seconds`, `steps`, either may be None.
    budget: Limits
    #: Training frames that the method was given: `perturbed`, or an oracle's choice. The oldest
    #: files do not say it: there was nothing to choose.
    frames: Line = field(default="perturbed", kw_only=True)
    #: Settings of every protocol that was scored, by name.
    protocols: FreeTable
    #: Versions, processor, system.
    environment: FreeTable
    #: When the evaluation started, ISO 8601, UTC.
    started: Line
    #: One entry a capture.
    captures: Annotated[list[CaptureResult], Meta(max_length=MAX_CAPTURES)]
    #: Version of the toolkit.
    toolkit: Line

    def __post_init__(self) -> None:
        check_table(self.protocols, "protocols")
        check_table(self.environment, "environment")

    def __repr__(self) -> str:
        count, failed = len(self.captures), sum(item.failed_frames for item in self.captures)
        psnr = self.scores.get("psnr")
        parts = [
            f"{self.method.title} on {self.suite}",
            f"{count} capture{'' if count == 1 else 's'}",
            f"seed {self.seed}",
            *([] if psnr is None else [f"PSNR {psnr:.2f} dB"]),
            *([f"{failed} failed frames"] if failed else []),
        ]
        return f"Results({', '.join(parts)})"

    @property
    def drawn(self) -> bool:
        """Whether any frame could be scored; where none was, every score is a penalty."""
        return any(item.failed_frames < len(item.frames) for item in self.captures)

    @property
    def scores(self) -> Scores:
        """Mean of each metric over the perturbations; over the captures where there is none."""
        if not self.captures:
            return {}
        overall = aggregate(score_rows(self)).overall
        return overall.macro or overall.capture_mean

    @property
    def metrics(self) -> list[str]:
        """Names of the metrics that every frame has."""
        for capture in self.captures:
            for frame in capture.frames:
                return list(frame.scores)
        return []


def score_rows(results: Results) -> list[CaptureScores]:
    """Return the captures as `hwp_bench.metrics.score` takes them."""
    return [
        CaptureScores(
            id=capture.id,
            hands=capture.hands,
            perturbations=tuple(capture.perturbations),
            frames={frame.frame: frame.scores for frame in capture.frames},
        )
        for capture in results.captures
    ]


def differing_makers(first: CaptureResult, second: CaptureResult) -> str:
    """Return who made two captures of one name, for the end of a message; empty if the same."""
    if first.made_by == second.made_by:
        return ""
    makers = [item.made_by or "an importer that is not stated" for item in (first, second)]
    return f": made by {makers[0]}, and by {makers[1]}"


def differing_settings(results: Sequence[Results]) -> list[str]:
    """Return for each result those of its settings in which results of its title differ.

    Returns:
        Texts such as `prior = "", steps = 300`, with `default` where a result says nothing; empty
        where all settings are the same.
    """
    texts = [
        {name: canonical_json(value) for name, value in result.method.settings.items()}
        for result in results
    ]
    told = []
    for result, mine in zip(results, texts, strict=True):
        twins = [
            table
            for other, table in zip(results, texts, strict=True)
            if other.method.title == result.method.title
        ]
        names = sorted({name for table in twins for name in table})
        told.append(
            ", ".join(
                f"{name} = {mine[name][:_SHOWN]}" if name in mine else f"{name} default"
                for name in names
                if len({table.get(name) for table in twins}) > 1
            )
        )
    return told
