"""The stages of a job, in order. Another one is another line here."""

from __future__ import annotations

from wildghand.from_video.capture import IMPORT
from wildghand.from_video.fit import FIT, PLACE
from wildghand.from_video.page import PAGE
from wildghand.from_video.sheet import SHEET
from wildghand.from_video.stage import Stage
from wildghand.from_video.track import TRACK
from wildghand.from_video.turntable import TURNTABLE

STAGES: tuple[Stage, ...] = (
    TRACK,
    IMPORT,
    FIT,
    PLACE,
    TURNTABLE,
    SHEET,
    PAGE,
)
