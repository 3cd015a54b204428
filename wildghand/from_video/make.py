"""An avatar of a video, made in stages, and `wildghand.fit`: of a video or of a capture."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil

from hwp_bench.base.errors import BadInput, UsageError, of_type, place, real_number, whole_number
from hwp_bench.base.files import check_places
from hwp_bench.base.folders import exclusive
from hwp_bench.base.images import check_encoder
from hwp_bench.capture import Capture, open_capture
from hwp_bench.importers.video import VideoImport
from hwp_bench.importers.video.decode import probe
from hwp_bench.importers.video.glimpse import Glimpse
from hwp_bench.methods.contract import Budget
from hwp_bench.tracking.networks import LiteRtNetworks, load_models
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import DESCRIPTION, load_avatar
from wildghand.fitting.method import read_usable
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.fitting.session import Watch, fit_capture
from wildghand.fitting.tensorboard import logging_fit
from wildghand.from_video.run import (
    FRAMES,
    JobRecord,
    VideoFit,
    VideoJob,
    read_record,
    run_stages,
    stride,
    with_quick,
)
from wildghand.from_video.stages import STAGES, Import
from wildghand.from_video.verdict import Verdict, read_verdict


@dataclass(frozen=True, eq=False)
class MadeAvatar:
    """The avatar of a video, and how it was made."""

    #: The avatar; `avatar.folder` is where it lies.
    avatar: WildGHandAvatar
    #: Its files.
    job: VideoJob
    #: Seconds of every stage, those of earlier runs included.
    record: JobRecord
    #: Names of the stages that earlier runs had done.
    kept: tuple[str, ...]

    def video_facts(self) -> dict[str, Any]:
        """Return what the import took down of the video; nothing where its capture is gone."""
        with contextlib.suppress(BadInput):
            video = open_capture(self.job.capture).info.source.get("video")
            return dict(video) if isinstance(video, Mapping) else {}
        return {}

    def verdict(self) -> Verdict | None:
        """Return how good the avatar is, and what to film next; None where `work` is gone."""
        return read_verdict(self.job.verdict) if self.job.verdict.is_file() else None

    def facts(self) -> dict[str, Any]:
        """Return the facts about the avatar, for JSON."""
        fit, job, verdict = self.avatar.record, self.job, self.verdict()
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
            "verdict": None if verdict is None else asdict(verdict),
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
    """Return where the avatar of a video goes by default: `hand_avatar` for `hand.mp4`."""
    return video.with_name(f"{video.stem}_avatar")


def folder_of(source: str | os.PathLike[str], out: str | os.PathLike[str] | None) -> Path | None:
    """Return where the avatar of a video or a capture goes; None: nowhere."""
    if out is not None:
        return Path(out)
    return default_folder(Path(source)) if is_video(source) else None


def make_avatar(
    video: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    options: VideoFit | None = None,
    *,
    overwrite: bool = False,
    world: World = SINGLE_PROCESS,
    watch: Watch | None = None,
    glimpse: Glimpse | None = None,
) -> MadeAvatar:
    """Make an avatar of the hand in a video, with a clip and a sheet to look at.

    The same call continues after a stop: finished stages are kept, the fit continues from its saved
    state. Stages whose video, landmarks or settings have changed are run again, and those that
    build on them.

    Args:
        video: any file that `hwp_bench.importers.video.decode` reads.
        out: folder of the avatar; None: `default_folder`.
        options: choices; the defaults where None.
        overwrite: make everything again; replace an avatar that came from elsewhere.
        world: the processes that fit together.
        watch: who is shown the fit while it runs.
        glimpse: who is shown the hands while they are imported.

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
    job = VideoJob(Path(video), folder, options, world, watch, glimpse)
    chosen = read_usable(options.method_settings())
    world.shard(chosen.schedule.batch)
    if world.is_main:
        _check_folder(job, overwrite=overwrite)
        _check_requirements(job, overwrite=overwrite)
    with exclusive(job.work) if world.is_main else contextlib.nullcontext():
        if overwrite and world.is_main:
            job.record.unlink(missing_ok=True)
        record, kept = run_stages(job, STAGES)
    return MadeAvatar(load_avatar(folder, hand=options.hand_model), job, record, tuple(kept))


def _check_folder(job: VideoJob, *, overwrite: bool) -> None:
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
    problem = "exists and is not the folder of an avatar that was made of a video"
    remedy = "Choose another name, or delete it."
    if (folder / DESCRIPTION).is_file():
        problem = "holds an avatar whose folder work is gone, or that was made of a capture"
        remedy = "Choose another name, or give --overwrite to make it again."
    raise UsageError(problem, where=folder, remedy=remedy)


def _is_imported(job: VideoJob) -> bool:
    """Whether an earlier run has imported the video, and with the same choices."""
    last = read_record(job.record).stages.get(Import.name)
    if last is None or not (last.done and job.metadata.is_file() and job.landmarks.is_file()):
        return False
    return not last.changed(Import().facts(job))


# Bytes of a job, for each stored pixel and for all the rest: on the disk, and in memory, where the
# import holds frames at twice the stored edge too.
_DISK_PIXEL, _DISK_REST = 6, 100_000_000
_MEMORY_PIXEL, _MEMORY_REST = 23, 1_500_000_000


def _check_requirements(job: VideoJob, *, overwrite: bool) -> None:
    """Check what a job needs before anything of it is made: video, programs, disk, memory."""
    info = probe(job.video)
    check_encoder()
    if job.options.landmarks is None and not job.landmarks.is_file():
        LiteRtNetworks(load_models(job.options.tracker))
    count = info.stated_frames or FRAMES
    frames = -(-count // stride(count, job.options.most_frames))
    pixels = frames * job.options.size**2
    place = next(one for one in (job.folder, *job.folder.absolute().parents) if one.is_dir())
    left = {
        "of disk": (_DISK_REST + _DISK_PIXEL * pixels, shutil.disk_usage(place).free),
        "of memory": (_MEMORY_REST + _MEMORY_PIXEL * pixels, psutil.virtual_memory().available),
    }
    for name, (needed, free) in left.items():
        # After the import little is needed; to look for it reads the whole video.
        if needed > free and (overwrite or not _is_imported(job)):
            raise UsageError(
                f"{frames} frames need about {needed / 1e9:.1f} GB {name}, {free / 1e9:.1f} GB are "
                "free",
                where=place,
                remedy="Make room, or take fewer frames with --quick, or a smaller --size.",
            )


def is_video(source: str | os.PathLike[str]) -> bool:
    """Whether a source is a video: no folder, and something or a name that has an ending."""
    path = Path(source)
    return not path.is_dir() and (path.exists() or bool(path.suffix))


def fit(
    source: Capture | str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    quick: bool = False,
    settings: Mapping[str, Any] | None = None,
    seconds: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    all_frames: bool | None = None,
    overwrite: bool = False,
    side: str | None = None,
    landmarks: str | os.PathLike[str] | None = None,
    size: int | None = None,
    tensorboard: str | os.PathLike[str] | None = None,
) -> WildGHandAvatar:
    """Fit an avatar to a video or to a capture, as `wildghand fit` does.

    A fit with a folder saves its state; when it was stopped, the same call continues where it was.
    Of a video every stage is kept that has ended.

    Args:
        source: a video, a capture, or a capture's folder.
        out: the avatar folder to make. None writes nothing for a capture; for a video it is
            `hand_avatar` next to `hand.mp4`.
        quick: fewer Gaussians and steps, and frames of a video: about half of its time.
        settings: settings that override the defaults, such as `{"gaussians": 5000}`; the fields
            of `WildGHandSettings`, dotted for those of a component.
        seconds: limit of the fit, s.
        steps: limit of the fit in optimizer steps.
        seed: seed of all random numbers.
        all_frames: fit the validation and test frames too, but for the last twentieth, at most 12:
            for an avatar, not for a score. None: those of a video, not those of a capture.
        overwrite: replace an avatar that is there.
        side: of a video: `right`, `left`, `both` or `auto` (the default: one or both, as it shows).
        landmarks: of a video: its landmarks; None tracks them.
        size: of a video: edge of the square frames that are fitted, px (default: 256).
        tensorboard: folder for curves of the fit, which `tensorboard --logdir` shows while it runs.

    Returns:
        The avatar; `avatar.folder` is where it lies, and `wildghand.load_avatar` opens it again.

    Raises:
        UsageError: `out` exists, a capture is too short for a split, or an argument is for videos
            only, of another type or out of range.
        BadMethod: a setting is unknown or out of range.
        BadInput: the capture or the video is wrong, or no training frame can be used.
        MissingDependency: the tracker of hands, or tensorboard, is not installed.
        DidNotConverge: the fit diverged at once.
        HwpError: the video shows no hand, another fit is writing to `out`, or `out` cannot be
            written.
    """
    if not isinstance(source, Capture):
        source = place(source, "source")
    out = None if out is None else place(out, "out")
    landmarks = None if landmarks is None else place(landmarks, "landmarks")
    log = None if tensorboard is None else place(tensorboard, "tensorboard")
    read = source.root if isinstance(source, Capture) else source
    inputs = {"source": read, "landmarks": landmarks}
    check_places({"out": out}, inputs, replaces=overwrite)
    check_places({"tensorboard": log, "out": folder_of(read, out)}, inputs)
    of_type(settings, (Mapping, type(None)), "settings", "a table of settings by name")
    of_type(side, (str, type(None)), "side", "a text")
    seconds = None if seconds is None else real_number(seconds, "seconds")
    steps = None if steps is None else whole_number(steps, "steps")
    seed = whole_number(seed, "seed")
    size = None if size is None else whole_number(size, "size")
    if not isinstance(source, Capture) and is_video(source):
        options = VideoFit(
            side=side or "auto",
            landmarks=landmarks,
            quick=quick,
            all_frames=all_frames is not False,
            size=VideoImport.size if size is None else size,
            steps=steps,
            seconds=seconds,
            seed=seed,
            settings=settings or {},
        )
        with logging_fit(log) as watch:
            return make_avatar(source, out, options, overwrite=overwrite, watch=watch).avatar
    for name, value in (("side", side), ("landmarks", landmarks), ("size", size)):
        if value is not None:
            raise UsageError("is for videos; a capture says it itself", field=name)
    with logging_fit(log) as watch:
        return fit_capture(
            source.root if isinstance(source, Capture) else source,
            out,
            settings=with_quick(settings or {}, quick=quick),
            budget=Budget(seconds, steps),
            seed=seed,
            all_frames=all_frames is True,
            overwrite=overwrite,
            watch=watch,
        )
