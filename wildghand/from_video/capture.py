"""The second stage: frames, masks, hand parameters and cameras of the video."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import canonical_json, sha256_of
from hwp_bench.importers.shared.association import tracked_sides
from hwp_bench.importers.shared.landmarks import read_landmarks
from hwp_bench.importers.video import FrameRange, VideoImport, import_video
from hwp_bench.importers.video.imported_clip import IMPORTER_VERSION
from wildghand.from_video.job import Job
from wildghand.from_video.stage import Stage
from wildghand.from_video.track import frame_count, video_digest

#: Fewest frames with a hand that an avatar is made of.
FEWEST = 12
#: Seconds for an imported frame, and for a frame that is decoded only.
_FRAME, _DECODED = 0.3, 0.005


def stride(count: int, most: int) -> int:
    """Return the distance between imported frames: `count` frames become about `most` or fewer."""
    return max(1, round(count / most))


def import_options(job: Job) -> VideoImport:
    """Choose the frames and hands of an import.

    Raises:
        BadInput: too few frames show a hand.
    """
    choices = VideoImport(
        side=job.options.side,
        id=job.capture_id,
        hand_model=job.options.hand_model,
        overwrite=True,
        fit=job.options.importer,
    )
    sides = _wanted(job)
    hands = {
        side: read_landmarks(job.landmarks, min_score=choices.min_score, side=side)
        for side in sides
    }
    total = len(next(iter(hands.values())).score)
    step = stride(total, job.options.most_frames)
    seen = {side: int(np.count_nonzero(hand.detected[::step])) for side, hand in hands.items()}
    few = [side for side, count in seen.items() if count < FEWEST]
    if few and (len(few) == len(seen) or job.options.side == "both"):
        named = f"a {few[0]} hand" if few[0] else "a hand"
        raise BadInput(
            f"shows {named} in {seen[few[0]]} of {total} frames, an avatar needs {FEWEST} or more",
            where=job.video,
            remedy="Record some seconds in which the whole hand is visible and turns.",
        )
    frames = FrameRange(stride=step)
    if few:
        notice(f"The {few[0]} hand is in {seen[few[0]]} of {total} frames only and is left out.")
        return replace(
            choices, frames=frames, side=next(side for side in seen if side not in few) or "auto"
        )
    return replace(choices, frames=frames)


def _wanted(job: Job) -> tuple[str | None, ...]:
    """Sides of the hands to import; None where only the import's own fit can tell."""
    side = job.options.side
    if side in ("right", "left"):
        return (side,)
    return tracked_sides(job.landmarks) or (None,)


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
    import_video(job.video, job.landmarks, job.capture, import_options(job))


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
