"""The stages that fit the avatar and put it in its place."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from hwp_bench.base.errors import HwpError, reason_of
from hwp_bench.base.files import canonical_json, sha256_of
from hwp_bench.capture import open_capture
from hwp_bench.methods.contract import Budget
from wildghand.avatar.files import DESCRIPTION, MODEL, WEIGHTS
from wildghand.fitting.session import fit_capture, unfinished
from wildghand.from_video.job import Job
from wildghand.from_video.stage import Stage
from wildghand.model.settings import read_settings

#: Seconds for a step of 12,337 Gaussians, and what goes before the first.
_STEP, _START = 0.05, 25.0


def _facts(job: Job) -> dict[str, str]:
    options = job.options
    return {
        "capture": open_capture(job.capture).digest,
        "settings": canonical_json(options.method_settings()),
        "steps": str(options.steps),
        "seconds": str(options.seconds),
        "seed": str(options.seed),
        "choice of frames": "all" if options.all_frames else "split",
    }


def _run(job: Job) -> None:
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


def _discard(job: Job) -> None:
    shutil.rmtree(unfinished(job.fitted), ignore_errors=True)


def _expected(job: Job) -> float:
    settings = read_settings(job.options.method_settings())
    steps = job.options.steps or settings.schedule.steps
    spent = _STEP * steps * (0.3 + 0.7 * settings.gaussians / 12_337)
    limit = job.options.seconds
    return _START + (spent if limit is None else min(spent, limit))


def avatar_digest(folder: Path) -> str:
    """Return one digest of an avatar's tensors and description."""
    return sha256_of(folder / MODEL) + sha256_of(folder / DESCRIPTION)


def _place(job: Job) -> None:
    """Copy the avatar to its folder; its description comes last and makes it one."""
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


FIT = Stage(
    name="fit",
    title="Fitting the avatar",
    facts=_facts,
    result=lambda job: job.fitted / DESCRIPTION,
    run=_run,
    expected=_expected,
    discard=_discard,
    together=True,
)

PLACE = Stage(
    name="place",
    title="Placing the avatar",
    facts=lambda job: {"avatar": avatar_digest(job.fitted)},
    result=lambda job: job.folder / DESCRIPTION,
    run=_place,
    expected=lambda job: 0.1,
)
