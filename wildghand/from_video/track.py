"""The first stage: the landmarks of the hands in the video."""

from __future__ import annotations

from hwp_bench.base.files import check_is_file, sha256_of
from hwp_bench.importers.video.decode import probe
from hwp_bench.tracking import TrackerSettings, track_video
from hwp_bench.tracking.track_video import NoHandSeen
from wildghand.from_video.job import Job
from wildghand.from_video.stage import Stage

#: Seconds for a frame of 720p, and those before the first.
_FRAME, _START = 0.024, 1.0


def video_digest(job: Job) -> str:
    """SHA-256 (hex) of the video file."""
    return sha256_of(job.video)


def frame_count(job: Job) -> int:
    """Number of frames as the container states it; 600 where it states none."""
    return probe(job.video).stated_frames or 600


def _facts(job: Job) -> dict[str, str]:
    given, model = job.options.landmarks, job.options.tracker
    if given is not None:
        check_is_file(given, field="--landmarks")
        return {"landmarks": sha256_of(given)}
    return {"video": video_digest(job), "tracker": "shipped" if model is None else str(model)}


def _run(job: Job) -> None:
    if job.options.landmarks is not None:
        return
    try:
        track_video(
            job.video,
            job.landmarks,
            settings=TrackerSettings(),
            model=job.options.tracker,
            overwrite=True,
        )
    except NoHandSeen as error:
        raise NoHandSeen(
            error.problem,
            where=error.where,
            remedy="The whole hand must be visible. `hwp-bench data track --min-confidence 0.3` "
            "accepts less; give what it writes with --landmarks.",
        ) from error


TRACK = Stage(
    name="track",
    title="Tracking the hand",
    facts=_facts,
    result=lambda job: job.landmarks,
    run=_run,
    expected=lambda job: 0.0 if job.options.landmarks else _START + _FRAME * frame_count(job),
)
