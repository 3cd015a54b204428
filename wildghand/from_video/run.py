"""A job: a video on its way to an avatar, in stages that are kept when done.

my_hand/                    an avatar folder: avatar.json, model.safetensors, weights/
my_hand/turntable.mp4       the avatar turned around
my_hand/sheet.jpg           frames, the avatar in their poses, its weights, and all sides
my_hand/avatar.html         a page that turns and poses the avatar
my_hand/work                can be deleted once the avatar pleases; without it a second run needs
                            --overwrite, and makes everything again
    landmarks.npz           the tracked hands
    capture/                the imported capture
    avatar/, avatar.fit/    the finished fit; the state of one that continues
    verdict.json            how good the avatar is, and what to film next
    stages.json             what is done, with which video and settings

The record of a job says which stages have ended, and with which facts, so that a stopped job
continues where it was.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from hwp_bench.base.console import StagesView, notice
from hwp_bench.base.errors import BadCapture, BadInput
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.records import (
    MAX_COUNT,
    MAX_SECONDS,
    MAX_SEED,
    Seconds,
    merged,
    parse_record,
)
from hwp_bench.capture.schema import METADATA, check_id
from hwp_bench.importers.shared.output import check_choices
from hwp_bench.importers.video import SolveSettings, VideoImport
from hwp_bench.importers.video.glimpse import Glimpse
from wildghand.avatar.files import DESCRIPTION
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.fitting.session import Watch
from wildghand.model.settings import nested

#: About how many frames are imported of a longer video, by default and with `quick`: 20 s at 15
#: frames a second, and a third of that. Neighbours show the same. See `stride`.
FRAMES, QUICK_FRAMES = 300, 100
#: What the avatar of a video has in place of the method's settings: no Gaussians so wide that they
#: draw a rim outside of the hand, which a score hardly sees and a person does; opacities that are
#: the same in every pose, or dark spots open in the palm in new ones; and a fifth of the steps,
#: after which kept-out frames of a clip of so many gain nothing.
VIDEO: Mapping[str, Any] = MappingProxyType(
    {
        "max_scale": 0.003,
        "network": {"frame_opacities": False},
        "schedule": {"steps": 400},
    }
)
#: What `quick` changes of the method's settings: fewer Gaussians, fewer steps, in every mode.
QUICK: Mapping[str, Any] = MappingProxyType(
    {"gaussians": 5000, "schedule": {"steps": 250, "epochs": 0}}
)


@dataclass(frozen=True)
class VideoFit:
    """Choices of a fit to a video.

    Raises:
        UsageError: a choice makes no sense; it names the option.
    """

    #: Which hands, as `VideoImport.side`.
    side: str = "auto"
    #: The hand model, as `load_template` takes it.
    hand_model: str = "anny"
    #: Landmarks of the video, or None to track them.
    landmarks: Path | None = None
    #: The tracker's networks (`hwp_bench.tracking.networks.load_models`), or None for the cache.
    tracker: Path | None = None
    #: An avatar in about half of the time: fewer frames, Gaussians and steps.
    quick: bool = False
    #: Fit all frames but the last twentieth. False leaves the last fifth out, for a score.
    all_frames: bool = True
    #: Edge of the square frames that are fitted, px.
    size: int = VideoImport.size
    #: Numbers of the import's fit.
    importer: SolveSettings = field(default_factory=SolveSettings)
    #: Optimizer steps, or None for the settings' number.
    steps: int | None = None
    #: Most seconds of optimizing, or None.
    seconds: float | None = None
    #: Seed of all random numbers.
    seed: int = 0
    #: Settings of the method, as `wildghand.model.settings.read_settings` takes them; they win
    #: over `VIDEO` and `QUICK`.
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        VideoImport(side=self.side, size=self.size)  # refuses what an import refuses
        check_limits(self.steps, self.seconds, self.seed)
        check_choices(
            (
                "--model",
                self.landmarks is None or self.tracker is None,
                "is for tracking, and --landmarks names hands that are tracked already",
            ),
        )

    @property
    def most_frames(self) -> int:
        """About how many frames are imported of a longer video."""
        return QUICK_FRAMES if self.quick else FRAMES

    def method_settings(self) -> dict[str, Any]:
        """Return the method's settings, with what a video and `quick` change."""
        return merged(VIDEO, nested(with_quick(self.settings, quick=self.quick)))


def check_limits(steps: int | None, seconds: float | None, seed: int) -> None:
    """Refuse limits of a fit that are out of range, in the words of the command."""
    check_choices(
        ("--steps", steps is None or 1 <= steps <= MAX_COUNT, f"must be 1 to {MAX_COUNT}"),
        (
            "--budget",
            seconds is None or 0.0 < seconds <= MAX_SECONDS,
            f"must be more than 0, and at most {MAX_SECONDS:g} s",
        ),
        ("--seed", 0 <= seed <= MAX_SEED, f"must be 0 to {MAX_SEED}"),
    )


def with_quick(settings: Mapping[str, Any], *, quick: bool) -> dict[str, Any]:
    """Return settings of the method; if `quick`, with `QUICK` in place of what they leave out."""
    return merged(QUICK, nested(settings)) if quick else dict(settings)


def stride(count: int, most: int) -> int:
    """Return the distance between imported frames.

    It is the integer nearest to `count / most`: less than half more than `most` frames are
    imported of `count`.
    """
    return max(1, round(count / most))


class VideoJob:
    """One video, the folder of its avatar, the choices, and where everything lies.

    `world` are the processes that fit together; `watch` is who is shown the fit while it runs, and
    `glimpse` the hands while they are imported.
    """

    def __init__(
        self,
        video: Path,
        folder: Path,
        options: VideoFit,
        world: World = SINGLE_PROCESS,
        watch: Watch | None = None,
        glimpse: Glimpse | None = None,
    ) -> None:
        self.video, self.folder, self.options = video, folder, options
        self.world, self.watch, self.glimpse = world, watch, glimpse
        self.work = folder / "work"
        self.record = self.work / "stages.json"
        self.landmarks = options.landmarks or self.work / "landmarks.npz"
        self.capture = self.work / "capture"
        self.metadata = self.capture / METADATA
        self.fitted = self.work / "avatar"
        self.fit = self.fitted / DESCRIPTION
        self.avatar = folder / DESCRIPTION
        self.turntable = folder / "turntable.mp4"
        self.verdict = self.work / "verdict.json"
        self.sheet = folder / "sheet.jpg"
        self.page = folder / "avatar.html"

    @property
    def capture_id(self) -> str:
        """Id of the capture: the folder's name where it can be one."""
        try:
            check_id(self.folder.name, str(self.folder))
        except BadCapture:
            return "hand"
        return self.folder.name


#: Largest record that is read, bytes.
_MAX_BYTES = 1 << 20


class Stage(ABC):
    """One stage of a job.

    It is run when its facts differ from those of its last run, when that did not end, or when
    what it makes is missing.
    """

    #: Short name, in the record and in messages.
    name: str
    #: What it does, as progress shows it.
    title: str
    #: Whether all processes run it, or the first one only.
    together = False
    #: Name of the job's file that says that its result is there.
    makes = ""

    @abstractmethod
    def facts(self, job: VideoJob) -> dict[str, str]:
        """Digests and settings on which the result depends, by a readable name.

        The stages before it have ended when this is called.
        """

    def result(self, job: VideoJob) -> Path:
        """The file or folder that says that its result is there; else the job's, by its name."""
        place: Path = getattr(job, self.makes)
        return place

    @abstractmethod
    def run(self, job: VideoJob) -> None:
        """Make the result; where the last run with the same facts was stopped, it may continue."""

    @abstractmethod
    def expected(self, job: VideoJob) -> float:
        """Seconds that it should take on two cores; stages before it may not have been run."""

    def discard(self, job: VideoJob) -> None:  # noqa: B027
        """Remove what a stopped run left, because its facts are others; most leave nothing."""


@dataclass(frozen=True)
class StageRecord:
    """One stage as it was run last."""

    #: What its result depends on: digests and settings as texts, by name.
    facts: dict[str, str]
    #: Whether it ended; False for one that was begun.
    done: bool = False
    #: Seconds that it took.
    seconds: Seconds = 0.0
    #: Seconds of processor time that it took, on all cores together.
    cpu_seconds: Seconds = 0.0

    def changed(self, facts: Mapping[str, str]) -> list[str]:
        """Names of the facts that are others now."""
        return [one for one in {**facts, **self.facts} if facts.get(one) != self.facts.get(one)]


@dataclass(frozen=True)
class JobRecord:
    """The stages of a job that were run, by name."""

    schema: Literal["wildghand-stages/1"] = "wildghand-stages/1"
    stages: dict[str, StageRecord] = field(default_factory=dict)


def read_record(path: Path) -> JobRecord:
    """Read the record; an empty one where there is no file."""
    if not path.exists():
        return JobRecord()
    try:
        value = read_json(path, max_bytes=_MAX_BYTES)
        return parse_record(JobRecord, value, where=str(path), error=BadInput)
    except BadInput as error:
        raise BadInput(
            error.problem,
            where=error.where,
            field=error.field,
            remedy="Delete it, or give --overwrite, to make the avatar from the start.",
        ) from error


def write_record(path: Path, record: JobRecord) -> None:
    """Write the record, whole or not at all."""
    write_json(path, asdict(record))


def run_stages(job: VideoJob, stages: Sequence[Stage]) -> tuple[JobRecord, list[str]]:
    """Run the stages that are not done; every process of the job's world calls this."""
    if not job.world.is_main:
        for stage in stages:
            if job.world.broadcast(0.0):
                if stage.together:
                    stage.run(job)
                job.world.wait_for_main()
        return JobRecord(), []
    known = read_record(job.record).stages
    # An older version may have had other stages.
    names = [stage.name for stage in stages]
    record = JobRecord(stages={name: known[name] for name in names if name in known})
    expected, ran = [stage.expected(job) for stage in stages], dict[int, float]()
    kept: list[str] = []
    with StagesView() as view:
        for number, stage in enumerate(stages):
            facts, last = stage.facts(job), record.stages.get(stage.name)
            reason = _reason_to_run(job, stage, last, facts)
            job.world.broadcast(float(reason is not None))
            if reason is None:
                kept.append(stage.name)
                continue
            own, later = seconds_left(expected, ran, number)
            view.stage(number + 1, len(stages), stage.title, own=own, later=later)
            if kept and number == len(kept):
                notice(f"Done before and kept: {', '.join(kept)}.")
            if reason:
                notice(reason)
            if last is None or last.changed(facts):
                stage.discard(job)
            record.stages[stage.name] = StageRecord(facts)
            write_record(job.record, record)
            began, began_cpu = _now()
            stage.run(job)
            job.world.wait_for_main()
            ended, ended_cpu = _now()
            ran[number] = ended - began
            record.stages[stage.name] = StageRecord(facts, True, ran[number], ended_cpu - began_cpu)
            write_record(job.record, record)
    if len(kept) == len(stages):
        notice(f"{job.folder}: all is done already, and nothing has changed.")
    return record, kept


def _reason_to_run(
    job: VideoJob, stage: Stage, last: StageRecord | None, facts: Mapping[str, str]
) -> str | None:
    """Say why a stage is run again; nothing the first time, None where it is done."""
    if last is None:
        return ""
    if changed := last.changed(facts):
        return f"{stage.title} again; changed since the last run: {', '.join(changed)}."
    if not last.done:
        return f"{stage.title} once more: the last run was stopped there."
    if not stage.result(job).exists():
        return f"{stage.title} once more: its result is missing."
    return None


def seconds_left(
    expected: Sequence[float], ran: Mapping[int, float], stage: int
) -> tuple[float, float]:
    """Seconds that a stage may take, and all after it, by those that `ran` took on this machine."""
    planned = sum(expected[one] for one in ran)
    factor = sum(ran.values()) / planned if planned > 0.0 else 1.0
    return factor * expected[stage], factor * sum(expected[stage + 1 :])


def _now() -> tuple[float, float]:
    """The clock, and the processor time of this process and of those that it has started, s."""
    used = os.times()
    return time.perf_counter(), used.user + used.system + used.children_user + used.children_system
