"""The result file: its records, how it is found, and reading that checks what it is given.

A field that was added within a version has a default, which says what files without it mean.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadResult
from hwp_bench.base.files import canonical_json, inside, read_json, write_json
from hwp_bench.base.progress import notice
from hwp_bench.base.records import parse_record, without_schema
from hwp_bench.metrics.aggregate import CaptureScores, Scores, aggregate

#: Version of the result file.
SCHEMA = "hwp-results/1"
#: Name of the file that makes a folder an ablation.
ABLATION = "ablation.json"
#: Version of that file.
ABLATION_SCHEMA = "hwp-ablation/1"
# Longest text of a setting's value.
_SHOWN = 40


@dataclass(frozen=True)
class FrameResult:
    """The scores of one test frame."""

    #: Index in the capture.
    frame: int
    #: Score by metric; a failed frame has the declared penalties.
    scores: dict[str, float]
    #: Why the frame could not be scored, or None.
    failure: str | None


@dataclass(frozen=True)
class CurvePoint:
    """The state of a fit at one checkpoint."""

    #: Optimizer steps done.
    step: int
    #: Seconds on the method's clock.
    seconds: float
    #: Peak memory of the method's process until then, bytes.
    peak_memory: int
    #: Mean score over the validation frames that were rendered.
    scores: dict[str, float]


@dataclass(frozen=True)
class FreeViewResult:
    """The scores of the free-view clip of a capture, apart from those of its test frames."""

    #: Digest of the clip.
    digest: str
    #: Every frame of the clip, in order.
    frames: list[FrameResult]
    #: SHA-256 over the decoded pixels of the predictions, in frame order.
    predictions_digest: str


@dataclass(frozen=True)
class CaptureResult:
    """One method on one capture."""

    #: Id of the capture.
    id: str
    #: Digest of the capture.
    digest: str
    #: `right`, `left` or `both`.
    hands: str
    #: Names of the perturbations that it declares.
    perturbations: list[str]
    #: Digest of the split.
    split_digest: str
    #: True where the scoring masks are exact coverage, False where they are estimates.
    exact_masks: bool
    #: Digest of everything that decides the scores; equal keys need no second run.
    key: str
    #: Every frame that the split lists, in order.
    frames: list[FrameResult]
    #: Why the method failed on the whole capture, or None.
    failure: str | None
    #: SHA-256 over the decoded pixels of the predictions, in frame order.
    predictions_digest: str
    #: Seconds on the method's clock.
    fit_seconds: float | None
    #: Seconds to render the test frames.
    render_seconds: float | None
    #: Seconds to score them.
    score_seconds: float
    #: Seconds of the method's process from start to end.
    wall_seconds: float
    #: Optimizer steps.
    steps: int | None
    #: Peak memory of the method's process, bytes.
    peak_memory: int | None
    #: Device that the method says it ran on.
    device: str | None
    #: Validation scores over time.
    curve: list[CurvePoint]
    #: Seconds that the method's process spent on checkpoints, outside the method's clock.
    curve_seconds: float | None = None
    #: Seconds of everything: reading, copying, the method's process, scoring, images.
    job_seconds: float | None = None
    #: CPU seconds of the method's process on its clock, all threads added up: the seconds that
    #: the fit would take on one core. None where it was not recorded.
    cpu_seconds: float | None = None
    #: How the method's process was isolated: `namespaces`, or `processes` with the reason why
    #: not more; None for predictions that came as files, and where it was not recorded.
    isolation: str | None = None
    #: Scores of the free-view clip; None where the capture has none, or the method drew none.
    free_view: FreeViewResult | None = None
    #: Importer and version that made the hand parameters and masks, such as `video 2`; None where
    #: the capture does not say so (simulated ones do not), and where it was not recorded.
    made_by: str | None = None

    @property
    def failed_frames(self) -> int:
        """How many frames could not be scored."""
        return sum(frame.failure is not None for frame in self.frames)


@dataclass(frozen=True)
class MethodId:
    """Which method, in which state."""

    #: Short name.
    name: str
    #: Name in tables.
    title: str
    #: Digest of the method directory's text files.
    digest: str
    #: Preset that was asked for, `default` if none.
    preset: str
    #: The settings that it was run with.
    settings: dict[str, Any]


@dataclass(frozen=True, repr=False)
class Results:
    """One evaluation: a method on a set of captures."""

    #: The method.
    method: MethodId
    #: Name of the suite, or `captures` when captures were named one by one.
    suite: str
    #: Seed of everything random.
    seed: int
    #: Limits of the fit: `seconds`, `steps`, either may be None.
    budget: dict[str, Any]
    #: Training frames that the method was given: `perturbed`, or an oracle's choice. The oldest
    #: files do not say it: there was nothing to choose.
    frames: str = field(default="perturbed", kw_only=True)
    #: Settings of every protocol that was scored, by name.
    protocols: dict[str, Any]
    #: Versions, processor, system.
    environment: dict[str, Any]
    #: When the evaluation started, ISO 8601, UTC.
    started: str
    #: One entry a capture.
    captures: list[CaptureResult]
    #: Version of the toolkit.
    toolkit: str

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


def write_results(path: str | os.PathLike[str], results: Results) -> Path:
    """Write a result file atomically."""
    return write_json(path, {"schema": SCHEMA, **asdict(results)})


def read_results(path: str | os.PathLike[str]) -> Results:
    """Read a result file, or the `results.json` of a results folder.

    Raises:
        BadInput: missing or no JSON.
        BadResult: of another version, a field is missing, unknown, of the wrong type, or a
            score is not finite; the field is named.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "results.json"
    value = read_json(path)
    return parse_record(Results, without_schema(value, SCHEMA, where=path), where=path)


def result_files(path: str | os.PathLike[str]) -> list[Path]:
    """Return the result files that a path stands for.

    Args:
        path: a `results.json`, a results folder, an `ablation.json`, or an ablation's folder.

    Raises:
        BadInput: an `ablation.json` is damaged, or names a file outside its folder.
        BadResult: it is of another version.
    """
    place = Path(path)
    record = place / ABLATION if place.is_dir() else place
    if record.name != ABLATION or not record.is_file():
        return [place / "results.json" if place.is_dir() else place]
    value = without_schema(read_json(record), ABLATION_SCHEMA, where=record)
    try:
        names = [name for variant in value["variants"] for name in variant["results"]]
        return [inside(record.parent, name) for name in names]
    except (KeyError, TypeError) as error:
        raise BadResult("does not list its results", where=record, field="variants") from error


def results_among(paths: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Return the result files that several paths stand for, such as `runs/*`.

    Folders and files that hold no results (figures, notes, other commands' folders) are left out
    and said, as long as another path holds some.

    Raises:
        BadInput, BadResult: as `result_files`.
    """
    places = list(paths)
    others = [path for path in places if _holds_none(Path(path))]
    if len(others) == len(places):
        others = []
    for path in others:
        notice(f"left out: {os.fspath(path)} holds no results")
    return [file for path in places if path not in others for file in result_files(path)]


def _holds_none(place: Path) -> bool:
    if place.is_dir():
        return not any((place / name).is_file() for name in ("results.json", ABLATION))
    return place.is_file() and place.suffix != ".json"


def read_all(paths: Iterable[str | os.PathLike[str]]) -> list[Results]:
    """Read every evaluation that some paths stand for, in order.

    Raises:
        BadInput, BadResult: one is missing or damaged.
    """
    return [read_results(file) for file in results_among(paths)]


def score_rows(results: Results) -> list[CaptureScores]:
    """Return the captures as `hwp_bench.metrics.aggregate` takes them."""
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
