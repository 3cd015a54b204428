"""The stage that writes the avatar's page: one file that turns and poses it in a browser."""

from __future__ import annotations

from hwp_bench.capture import open_capture
from wildghand.avatar.files import load_avatar
from wildghand.from_video.fit import avatar_digest
from wildghand.from_video.job import Job
from wildghand.from_video.stage import Stage
from wildghand.page import write_page

#: Version of what the page shows; part of the stage's facts.
_VERSION = 1
# Seconds on two cores.
_SECONDS = 15.0


def _run(job: Job) -> None:
    avatar = load_avatar(job.folder, hand=job.options.hand_model)
    write_page(avatar, job.page, capture=open_capture(job.capture), overwrite=True)


PAGE = Stage(
    name="page",
    title="Writing the page",
    facts=lambda job: {"avatar": avatar_digest(job.folder), "look of the page": str(_VERSION)},
    result=lambda job: job.page,
    run=_run,
    expected=lambda job: _SECONDS,
)
