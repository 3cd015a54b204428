"""The records of a result file, their bounds, and what is read off them.

A field that was added within a version has a default, which says what files without it mean.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import platform
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from hwp_bench.base import packages
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import canonical_json, files_digest
from hwp_bench.base.records import Count, Digest, Line, Message, Moment, Seconds, Seed, flattened
from hwp_bench.base.tables import Table
from hwp_bench.metrics import METRICS
from hwp_bench.metrics.score import CaptureScores, Scores, aggregate

if TYPE_CHECKING:
    import pandas

#: Largest result file that is read, bytes; one of 10,000 frames stays far below it.
MAX_BYTES = 64 << 20
#: Most captures of a result, frames of a capture, and points of a curve.
MAX_CAPTURES, MAX_FRAMES, MAX_CURVE = 1_000, 100_000, 10_000
#: Most metrics of a frame.
MAX_METRICS = 100
#: Most characters of the settings, the protocols or the environment as JSON.
MAX_TABLE = 500_000
#: Shortest time that a rate is computed from, s; below it a clock has measured nothing.
SHORTEST = 1e-9
# By how much a score may leave the range of its metric: sums are rounded.
_ROUNDING = 1e-9
#: Scores by metric; a metric that the toolkit knows has its own range, which is narrower.
ScoreTable = Annotated[
    dict[Line, Annotated[float, Meta(ge=-1e6, le=1e6)]], Meta(max_length=MAX_METRICS)
]
_Limit = Annotated[str, Meta(pattern=r"\A(?:seconds|steps)\Z", description="seconds or steps")]
#: Limits of a fit by name.
Limits = dict[_Limit, Count | Seconds | None]
#: A table of any values; `check_table` bounds all of it.
FreeTable = dict[Line, Any]
# Longest text of a setting's value.
_SHOWN = 40
# Steps that no fit of two minutes takes on the hardware of today.
_LIFTED = 100_000
#: What `CaptureResult.isolation` says of a run inside the sandbox.
ISOLATED = "namespaces"
#: What `Results.environment` says under `caches`: a run finds nothing that a method wrote before.
NEW_CACHES = "new for each run"
#: Packages whose version can move a number.
PACKAGES = (
    *("numpy", "torch", "numba", "opencv-contrib-python-headless", "scikit-image", "OpenImageIO"),
    *("scipy", "trimesh", "embreex", "gsplat", "lpips"),
)


@dataclass(frozen=True)
class FrameResult:
    """The scores of one test frame."""

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

    digest: Line
    #: Every frame of the clip, in order.
    frames: Annotated[list[FrameResult], Meta(max_length=MAX_FRAMES)]
    #: SHA-256 over the decoded pixels of the predictions, in frame order.
    predictions_digest: Line


@dataclass(frozen=True)
class CaptureResult:
    """One method on one capture."""

    id: Line
    digest: Line
    #: `right`, `left` or `both`.
    hands: str = field(metadata={"choices": ("right", "left", "both")})
    #: Names of the perturbations that it declares.
    perturbations: Annotated[list[Line], Meta(max_length=20)]
    split_digest: Line
    #: True where the scoring masks are exact coverage, False where they are estimates.
    exact_masks: bool
    #: Digest of everything that decides the scores; equal keys need no second run.
    key: Line
    #: Every frame that the split lists, in order; at least one.
    frames: Annotated[list[FrameResult], Meta(min_length=1, max_length=MAX_FRAMES)]
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
    #: What an import was made from (`CaptureInfo.origin`): captures of one origin differ in
    #: rounding alone. None for others, and where it was not recorded.
    origin: Line | None = None
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


#: What a method can have been trained on before it sees a capture, in words for people.
TRAINING_KINDS = {
    "none": "none",
    "simulated": "simulated people",
    "public": "public data sets",
    "private": "private data",
}


#: What `TrainingData.private` holds where nobody has declared anything.
UNDECLARED = "not declared"


@dataclass(frozen=True)
class TrainingData:
    """The data that a method was trained on before it saw a capture; none where all is empty."""

    #: Simulated people: by the name of a scene the digests of what was rendered (`Scene.digest`,
    #: in a capture's file `source.scene_digest`). People without a scene have a name of their own.
    simulated: Annotated[
        dict[Line, Annotated[list[Digest], Meta(min_length=1, max_length=1000)]],
        Meta(max_length=1000),
    ] = field(default_factory=dict)
    #: Data sets that anybody can have, by name.
    public: Annotated[list[Line], Meta(max_length=100)] = field(default_factory=list)
    #: Data that others cannot have, each in a few words.
    private: Annotated[list[Line], Meta(max_length=100)] = field(default_factory=list)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Which of `TRAINING_KINDS` it is of; at least one."""
        return tuple(name for name in TRAINING_KINDS if getattr(self, name, None)) or ("none",)

    @property
    def text(self) -> str:
        """Kinds and names, in words for people."""
        names = {name: ", ".join(getattr(self, name, ())) for name in self.kinds}
        parts = [TRAINING_KINDS[name] + (f" ({own})" if own else "") for name, own in names.items()]
        return "; ".join(parts)

    def shared(self, scenes: Mapping[str, str]) -> list[str]:
        """Return which of some scenes or clips, digests by name, are among it.

        One is known by its name, whoever is seen in it, and by its digest under any name.
        """
        digests = {digest for own in self.simulated.values() for digest in own}
        names = {*self.simulated, *self.public, *self.private}
        return [name for name, digest in scenes.items() if name in names or digest in digests]


@dataclass(frozen=True)
class MethodId:
    """Which method, in which state."""

    #: Short name.
    name: Line
    #: Name in tables.
    title: Line
    #: Digest of every file and link of the method (`MethodManifest.contents`).
    digest: Line
    #: Preset that was asked for, `default` if none.
    preset: Line
    #: The settings that it was run with.
    settings: FreeTable
    #: What it was trained on before, as its `method.toml` declares it.
    training: TrainingData
    #: What it declares to use validation frames for; None where it does not say, and where it was
    #: not recorded.
    validation: Annotated[list[Line], Meta(max_length=10)] | None = None

    def __post_init__(self) -> None:
        check_table(self.settings, "settings")


@dataclass(frozen=True, repr=False)
class Results:
    """One evaluation: a method on a set of captures."""

    method: MethodId
    #: Name of the suite, or `captures` when captures were named one by one.
    suite: Line
    #: Seed of all random numbers.
    seed: Seed
    #: Limits of the fit: `seconds`, `steps`, either may be None.
    budget: Limits
    #: Training frames that the method was given: `perturbed`, or an oracle's choice.
    frames: Line = field(default="perturbed", kw_only=True)
    #: Settings of every protocol that was scored, by name.
    protocols: FreeTable
    #: Versions, processor, system.
    environment: FreeTable
    #: When the evaluation started, ISO 8601, UTC.
    started: Moment
    captures: Annotated[list[CaptureResult], Meta(max_length=MAX_CAPTURES)]
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

    def to_frame(self, *, free_view: bool = False) -> pandas.DataFrame:
        """Return the scores as a table of pandas with a row for each test frame.

        Its columns are `method`, `suite`, `seed`, `capture`, `frame`, one for each metric, and
        `failure`. `free_view` takes the frames of the free-view clips instead. Tables of several
        results are joined by `pandas.concat`.

        Raises:
            MissingDependency: pandas is not installed.
        """
        frames = packages.import_extra("pandas", "pandas", "pandas is not installed")
        head = {"method": self.method.title, "suite": self.suite, "seed": self.seed}
        parts = [(item.id, item.free_view if free_view else item) for item in self.captures]
        rows = [(name, one) for name, part in parts for one in (part.frames if part else ())]
        table: pandas.DataFrame = frames.DataFrame(
            {**head, "capture": name, "frame": one.frame, **one.scores, "failure": one.failure}
            for name, one in rows
        )
        return table

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


# --- bounds, checked before a number is used


def check_scores(scores: Mapping[str, float]) -> None:
    """Refuse scores that their metric cannot have."""
    for facts in METRICS:
        value = scores.get(facts.name)
        low, high = facts.range
        high = math.inf if high is None else high
        if value is not None and not low - _ROUNDING <= value <= high + _ROUNDING:
            limits = f"from {low:g} to {high:g}" if high < math.inf else f"at least {low:g}"
            raise UsageError(
                f"is {value:g}, but {facts.label} is {limits}", field=f"scores.{facts.name}"
            )


def check_table(value: Mapping[str, Any], name: str) -> None:
    """Refuse a table of any values that is too large to be shown."""
    if len(json.dumps(value)) > MAX_TABLE:
        raise UsageError(f"holds more than {MAX_TABLE:,} characters", field=name)


def lifted_steps(seconds: float) -> int:
    """Return the limit of steps next to one in seconds alone: more than a fit takes in them.

    These are 1,000 a second, and at least 100,000.
    """
    return max(_LIFTED, math.ceil(1_000 * seconds))


def budget_text(budget: Mapping[str, Any]) -> str:
    """Return a budget in words: `60 s`, `60 s, 900 steps` or `no limit`.

    A limit of steps that seconds alone have lifted (`lifted_steps`) is left out.
    """
    seconds, steps = budget.get("seconds"), budget.get("steps")
    if seconds and steps == lifted_steps(seconds):
        steps = None
    limits = ((seconds, "s"), (steps, "steps"))
    return ", ".join(f"{value:,.15g} {unit}" for value, unit in limits if value) or "no limit"


def per_second(count: int, seconds: float | None) -> float | None:
    """Return a rate; None where no time was measured, or one too short to divide by."""
    return None if seconds is None or seconds < SHORTEST else count / seconds


# --- what is read off results


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


def shown_files(results: Results) -> list[str]:
    """Return digests of the files that the method was shown besides its folder and the request."""
    return sorted({capture.exposed for capture in results.captures if capture.exposed})


# As `hwp_bench.methods.manifest.find_setting_files` writes a file or folder of a person.
_FILE = re.compile(r"\A([a-z][a-z0-9-]*):/.*\Z", re.DOTALL)


def without_places(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings in which a file is its kind alone; `shown_files` has its content."""
    return {
        name: _FILE.sub(r"\1:", value) if isinstance(value, str) else value
        for name, value in flattened(settings)
    }


def differing_settings(results: Sequence[Results]) -> list[str]:
    """Return for each result those of its settings in which results of its title differ."""
    texts = [
        {name: canonical_json(value) for name, value in result.method.settings.items()}
        for result in results
    ]
    told = []
    for result, mine in zip(results, texts, strict=True):
        title = result.method.title
        twins = [
            table
            for other, table in zip(results, texts, strict=True)
            if other.method.title == title
        ]
        names = sorted({name for table in twins for name in table})
        different = [name for name in names if len({table.get(name) for table in twins}) > 1]
        own = [f"{name} = {mine[name][:_SHOWN]}" for name in different if name in mine]
        told.append(", ".join(own) if own or not different else "default settings")
    return told


# --- how the method's processes were isolated


def unisolated_captures(results: Results) -> dict[str, list[str]]:
    """Return the ids of the captures that a method ran on without a sandbox, by the reason.

    The reason is empty where a person asked for none. Predictions that came as files, and results
    of versions that recorded nothing, are left out.
    """
    found: dict[str, list[str]] = {}
    for capture in results.captures:
        if capture.isolation is not None and capture.isolation != ISOLATED:
            _, _, reason = capture.isolation.partition(" ")
            found.setdefault(reason.strip("()"), []).append(capture.id)
    return found


def isolation_text(results: Results, head: str = "") -> str:
    """Say how the method's process was isolated; empty where nothing is known of it."""
    open_runs = unisolated_captures(results)
    if not open_runs:
        walled = any(capture.isolation == ISOLATED for capture in results.captures)
        return f"isolation: {head}{ISOLATED}" if walled else ""
    parts = [
        ", ".join(ids) + (f" (the system refuses them: {reason})" if reason else "")
        for reason, ids in open_runs.items()
    ]
    return (
        f"warning: {head}no isolation on {'; '.join(parts)}. The method could read every file that "
        "its user can read, test frames among them, and use the network. --isolation required "
        "refuses to run without a sandbox."
    )


def isolation_note(results: Sequence[Results]) -> str:
    """Return a line for a table, naming methods that ran without a sandbox; empty if none."""
    titles = [one.method.title for one in results if unisolated_captures(one)]
    names = ", ".join(dict.fromkeys(titles))
    return f"Run without a sandbox, where test frames can be read: {names}." if names else ""


def add_isolation_note(table: Table, results: Sequence[Results]) -> Table:
    """Return a table with `isolation_note` below it, once."""
    note = isolation_note(results)
    return table if note in ("", *table.notes) else replace(table, notes=(*table.notes, note))


# --- what validation frames are used for


def add_validation_note(table: Table, results: Sequence[Results]) -> Table:
    """Return a table with a line below it of what each method uses validation frames for."""
    titles: dict[str, dict[str, None]] = {}
    for one in results:
        uses = one.method.validation
        text = "not declared" if uses is None else ", ".join(uses) or "nothing"
        titles.setdefault(text, {})[one.method.title] = None
    if titles.keys() <= {"not declared"}:
        return table
    told = "; ".join(f"{', '.join(names)}: {text}" for text, names in titles.items())
    return replace(table, notes=(*table.notes, f"Declared uses of validation frames: {told}."))


# --- the environment of a result


def environment() -> dict[str, Any]:
    """Return the versions, the processor and the system; no host name and no path.

    `code` is the digest of the toolkit's own modules, because a version number does not identify
    code under development, and `commit` that of a checkout. `caches` says what caches the methods
    began with.
    """
    versions = {}
    for package in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count(),
        "packages": versions,
        "code": code_digest(),
        "commit": packages.checkout_commit(),
        "caches": NEW_CACHES,
    }


def code_digest() -> str:
    """Return the SHA-256 (hex) of the toolkit's own modules: names and contents."""
    root = packages.PACKAGES / "hwp_bench"
    # The shipped methods lie in `_data` in a wheel and elsewhere in a checkout.
    modules = (path for path in root.rglob("*.py") if not path.is_relative_to(root / "_data"))
    return files_digest(root, modules)


def _processor() -> str:
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as stream:
        for line in stream:
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"
