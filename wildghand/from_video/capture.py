"""The second stage: frames, masks, hand parameters and cameras of the video."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import canonical_json, sha256_of
from hwp_bench.importers.shared.hand_tracks import tracked_side
from hwp_bench.importers.shared.landmarks import read_landmarks
from hwp_bench.importers.video import FrameRange, VideoImport, import_video
from hwp_bench.importers.video.imported_clip import IMPORTER_VERSION
from wildghand.from_video.job import Job
from wildghand.from_video.stage import Stage
from wildghand.from_video.track import frame_count, video_digest

#: Fewest frames with a hand that an avatar is made of.
FEWEST = 12
#: Seconds for an imported frame, and for a frame that is decoded only.
_FRAME, _DECODED = 0.25, 0.005


def stride(count: int, most: int) -> int:
    """Return the distance between imported frames: `count` frames become about `most` or fewer."""
    return max(1, round(count / most))


def _options(job: Job) -> VideoImport:
    side = job.options.side
    hand = tracked_side(job.landmarks) if side == "auto" else side
    choices = VideoImport(
        hand=hand,
        id=job.capture_id,
        hand_model=job.options.hand_model,
        overwrite=True,
        fit=job.options.importer,
    )
    landmarks = read_landmarks(job.landmarks, min_score=choices.min_score, side=hand)
    step = stride(len(landmarks.score), job.options.most_frames)
    seen = int(np.count_nonzero(landmarks.detected[::step]))
    if seen < FEWEST:
        raise BadInput(
            f"shows a {hand} hand in {seen} of {len(landmarks.score)} frames, an avatar needs "
            f"{FEWEST} or more",
            where=job.video,
            remedy="Record some seconds in which the whole hand is visible and turns.",
        )
    return replace(choices, frames=FrameRange(stride=step))


def _facts(job: Job) -> dict[str, str]:
    return {
        "video": video_digest(job),
        "landmarks": sha256_of(job.landmarks),
        "side": job.options.side,
        "hand model": job.options.hand_model,
        "number of frames": str(job.options.most_frames),
        "settings of the import": canonical_json(asdict(job.options.importer)),
        "version of the importer": str(IMPORTER_VERSION),
    }


def _run(job: Job) -> None:
    import_video(job.video, job.landmarks, job.capture, _options(job))


def _expected(job: Job) -> float:
    count = frame_count(job)
    return _FRAME * (count / stride(count, job.options.most_frames)) + _DECODED * count


IMPORT = Stage(
    name="import",
    title="Importing the hand",
    facts=_facts,
    result=lambda job: job.capture / "capture.json",
    run=_run,
    expected=_expected,
)
