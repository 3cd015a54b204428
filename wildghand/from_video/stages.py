"""The stages from a video to a placed avatar, and the order of all stages."""

# Methods of a stage are described where `Stage` declares them.
# ruff: noqa: D102

from __future__ import annotations

import os
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadInput, HwpError, reason_of
from hwp_bench.base.files import canonical_json, check_is_file, sha256_of
from hwp_bench.capture import open_capture
from hwp_bench.importers.shared.landmarks import read_association, read_landmarks
from hwp_bench.importers.video import FrameRange, VideoImport, import_video
from hwp_bench.importers.video.api import IMPORTER_VERSION
from hwp_bench.importers.video.decode import probe
from hwp_bench.methods.contract import Budget
from hwp_bench.tracking import TrackerSettings, track_video
from hwp_bench.tracking.track_video import NoHandSeen
from wildghand.avatar.files import DESCRIPTION, MODEL, WEIGHTS
from wildghand.fitting.session import fit_capture, unfinished
from wildghand.from_video.job import Job
from wildghand.from_video.pictures import DrawSheet, DrawTurntable, WritePage, avatar_digest
from wildghand.from_video.run import Stage
from wildghand.model.settings import read_settings

#: Fewest frames with a hand that an avatar is made of.
FEWEST = 12


def _frame_count(job: Job) -> int:
    """Number of frames as the container states it; 600 where it states none."""
    return probe(job.video).stated_frames or 600


class Track(Stage):
    """The landmarks of the hands in the video; nothing where a person gives them."""

    name, title = "track", "Tracking the hand"

    def facts(self, job: Job) -> dict[str, str]:
        given, model = job.options.landmarks, job.options.tracker
        if given is not None:
            check_is_file(given, field="--landmarks")
            return {"landmarks": sha256_of(given)}
        tracker = "shipped" if model is None else str(model)
        return {"video": sha256_of(job.video), "tracker": tracker}

    def result(self, job: Job) -> Path:
        return job.landmarks

    def run(self, job: Job) -> None:
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
                remedy="The whole hand must be visible. `hwp-bench data track --min-confidence "
                "0.3` accepts less; give what it writes with --landmarks.",
            ) from error

    def expected(self, job: Job) -> float:
        # A frame of 720p takes 24 ms.
        return 0.0 if job.options.landmarks else 1.0 + 0.024 * _frame_count(job)


class Import(Stage):
    """Frames, masks, hand parameters and cameras of the video."""

    name, title = "import", "Importing the hand"

    def facts(self, job: Job) -> dict[str, str]:
        return {
            "video": sha256_of(job.video),
            "landmarks": sha256_of(job.landmarks),
            "side": job.options.side,
            "hand model": job.options.hand_model,
            "number of frames": str(job.options.most_frames),
            "settings of the import": canonical_json(asdict(job.options.importer)),
            "version of the importer": str(IMPORTER_VERSION),
        }

    def result(self, job: Job) -> Path:
        return job.capture / "capture.json"

    def run(self, job: Job) -> None:
        import_video(job.video, job.landmarks, job.capture, import_options(job))

    def expected(self, job: Job) -> float:
        # A frame takes 0.3 s, one that is decoded only 5 ms.
        count = _frame_count(job)
        return 0.3 * (count / stride(count, job.options.most_frames)) + 0.005 * count


def stride(count: int, most: int) -> int:
    """Return the distance between imported frames: `count` frames become about `most` or fewer."""
    return max(1, round(count / most))


def import_options(job: Job) -> VideoImport:
    """Choose the frames and hands of an import; refuse a video that shows too few."""
    choices = VideoImport(
        side=job.options.side,
        id=job.capture_id,
        hand_model=job.options.hand_model,
        overwrite=True,
        fit=job.options.importer,
    )
    sides: tuple[str | None, ...] = (job.options.side,)
    if job.options.side not in ("right", "left"):
        # Where the landmarks do not say, only the import's own fit can tell.
        tracked = read_association(job.landmarks)
        sides = (None,) if tracked is None else tracked.sides
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


class Fit(Stage):
    """The avatar, fitted to the capture."""

    name, title, together = "fit", "Fitting the avatar", True

    def facts(self, job: Job) -> dict[str, str]:
        options = job.options
        return {
            "capture": open_capture(job.capture).digest,
            "settings": canonical_json(options.method_settings()),
            "steps": str(options.steps),
            "seconds": str(options.seconds),
            "seed": str(options.seed),
            "choice of frames": "all" if options.all_frames else "split",
        }

    def result(self, job: Job) -> Path:
        return job.fitted / DESCRIPTION

    def run(self, job: Job) -> None:
        options = job.options
        fit_capture(
            job.capture,
            job.fitted,
            settings=options.method_settings(),
            budget=Budget(options.seconds, options.steps),
            seed=options.seed,
            all_frames=options.all_frames,
            overwrite=True,
            world=job.world,
            watch=job.watch,
        )

    def discard(self, job: Job) -> None:
        shutil.rmtree(unfinished(job.fitted), ignore_errors=True)

    def expected(self, job: Job) -> float:
        settings = read_settings(job.options.method_settings())
        steps = job.options.steps or settings.schedule.steps
        # A step of 12,337 Gaussians takes 50 ms, what goes before the first 25 s.
        spent = 0.05 * steps * (0.3 + 0.7 * settings.gaussians / 12_337)
        limit = job.options.seconds
        return 25.0 + (spent if limit is None else min(spent, limit))


class Place(Stage):
    """The avatar in its folder; its description comes last and makes it one."""

    name, title = "place", "Placing the avatar"

    def facts(self, job: Job) -> dict[str, str]:
        return {"avatar": avatar_digest(job.fitted)}

    def result(self, job: Job) -> Path:
        return job.folder / DESCRIPTION

    def run(self, job: Job) -> None:
        try:
            (job.folder / DESCRIPTION).unlink(missing_ok=True)
            shutil.rmtree(job.folder / WEIGHTS, ignore_errors=True)
            if (job.fitted / WEIGHTS).is_dir():
                shutil.copytree(job.fitted / WEIGHTS, job.folder / WEIGHTS)
            for name in (MODEL, DESCRIPTION):
                partial = job.folder / f".{name}.partial"
                shutil.copyfile(job.fitted / name, partial)
                os.replace(partial, job.folder / name)
        except OSError as error:
            raise HwpError(f"cannot be written ({reason_of(error)})", where=job.folder) from error

    def expected(self, job: Job) -> float:
        return 0.1


#: The stages of a job, in order. Another one is another class here.
STAGES: tuple[Stage, ...] = (
    Track(),
    Import(),
    Fit(),
    Place(),
    DrawTurntable(),
    DrawSheet(),
    WritePage(),
)
