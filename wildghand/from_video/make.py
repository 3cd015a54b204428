"""An avatar of the hand in a video: what is checked before the stages, and what comes of them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.folders import exclusive
from hwp_bench.base.images import check_encoder
from hwp_bench.capture import open_capture
from hwp_bench.importers.video.decode import probe
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import DESCRIPTION, load_avatar
from wildghand.fitting.optimize import Watch
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.from_video.job import Job
from wildghand.from_video.record import JobRecord
from wildghand.from_video.run import run_stages
from wildghand.from_video.settings import VideoFit
from wildghand.from_video.stage import Stage
from wildghand.from_video.stages import STAGES
from wildghand.model.settings import read_settings


@dataclass(frozen=True, eq=False)
class MadeAvatar:
    """The avatar of a video, and how it was made.

    Attributes:
        avatar: the avatar; `avatar.folder` is where it lies.
        job: its files.
        record: seconds of every stage, those of earlier runs included.
        kept: names of the stages that earlier runs had done.
    """

    avatar: WildGHandAvatar
    job: Job
    record: JobRecord
    kept: tuple[str, ...]

    def video_facts(self) -> dict[str, Any]:
        """Return what the import took down of the video; nothing where its capture is gone."""
        with contextlib.suppress(BadInput):
            video = open_capture(self.job.capture).info.source.get("video")
            return dict(video) if isinstance(video, Mapping) else {}
        return {}

    def facts(self) -> dict[str, Any]:
        """Return what a program wants to know of it, for JSON."""
        fit, job = self.avatar.record, self.job
        return {
            "avatar": str(job.folder),
            "hands": list(self.avatar.sides),
            "frames": len(fit.frames),
            "steps": fit.steps,
            "seconds": fit.seconds,
            "turntable": str(job.turntable),
            "sheet": str(job.sheet),
            "page": str(job.page),
            "capture": str(job.capture),
            "video": self.video_facts(),
            "stages": [
                {
                    "name": name,
                    "seconds": stage.seconds,
                    "cpu_seconds": stage.cpu_seconds,
                    "kept": name in self.kept,
                }
                for name, stage in self.record.stages.items()
            ],
        }


def default_folder(video: Path) -> Path:
    """Return where the avatar of a video goes if nothing is said: `hand_avatar` for `hand.mp4`."""
    return video.with_name(f"{video.stem}_avatar")


def make_avatar(
    video: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    options: VideoFit | None = None,
    *,
    overwrite: bool = False,
    world: World = SINGLE_PROCESS,
    stages: Sequence[Stage] = STAGES,
    watch: Watch | None = None,
) -> MadeAvatar:
    """Make an avatar of the hand in a video, with a clip and a sheet to look at.

    The same call goes on after a stop: finished stages are kept, the fit continues from its saved
    state. Stages whose video, landmarks or settings have changed are run again, and those that
    build on them.

    Args:
        video: any file that `hwp_bench.importers.video.decode` reads.
        out: folder of the avatar; None: `default_folder`.
        options: choices; the defaults where None.
        overwrite: make everything again; replace an avatar that came from elsewhere.
        world: the processes that fit together.
        stages: what is run.
        watch: who is shown the fit while it runs.

    Raises:
        BadInput: the video cannot be used, or shows too few frames with a hand.
        BadMethod: a setting of the method is unknown or out of range.
        UsageError: `out` holds something else.
        MissingDependency: the tracker's or the encoder's package is not installed.
        HwpError: no hand is seen, the tracker's networks are not available, another process works
            on `out`, or it cannot be written to.
    """
    options = options or VideoFit()
    folder = default_folder(Path(video)) if out is None else Path(out)
    job = Job(Path(video), folder, options, world, watch)
    chosen = read_settings(options.method_settings())
    world.shard(chosen.schedule.batch)
    if world.is_main:
        probe(job.video)
        check_encoder()
        _check_folder(job, overwrite=overwrite)
    with exclusive(job.work) if world.is_main else contextlib.nullcontext():
        if overwrite and world.is_main:
            job.record.unlink(missing_ok=True)
        record, kept = run_stages(job, stages)
    return MadeAvatar(load_avatar(folder, hand=options.hand_model), job, record, tuple(kept))


def _check_folder(job: Job, *, overwrite: bool) -> None:
    """Refuse a folder that holds something else than this job."""
    folder = job.folder
    if folder.exists() and not folder.is_dir():
        raise UsageError("is a file", where=folder, field="-o", remedy="Name a folder.")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    # The lock may be all that an earlier run has left.
    ours = job.record.is_file() or [path.name for path in folder.iterdir()] == [job.work.name]
    if ours or (overwrite and (folder / DESCRIPTION).is_file()):
        return
    raise UsageError(
        "exists and is not the folder of an avatar that was made of a video",
        where=folder,
        remedy="Choose another name, or delete it.",
    )
