"""The stage that draws an avatar from all around, as it stands in its studio."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hwp_bench.base.console import track
from hwp_bench.base.images import as_uint8, write_movie
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar
from wildghand.from_video.fit import avatar_digest
from wildghand.from_video.job import Job
from wildghand.from_video.stage import Stage

#: Edge of the clip, px; frames of one turn, and in a second.
SIZE, FRAMES, FPS = 480, 96, 24
#: sRGB grey behind the hand.
BACKGROUND = 28
# Raises when the clip comes out otherwise, so that an older one is drawn again.
_VERSION = 2
# Seconds for a frame, and those before the first.
_FRAME, _START = 0.1, 4.0


class Turntable:
    """Draws an avatar at rest from all around (`wildghand.avatar.studio`).

    Args:
        avatar: what is drawn; two hands stand next to each other and turn together.
        size: edge of the square pictures, px.
    """

    def __init__(self, avatar: WildGHandAvatar, size: int = SIZE) -> None:
        self._avatar = avatar
        self._camera = avatar.studio.camera(size, size)

    def view(self, degrees: float) -> np.ndarray:
        """Draw the avatar turned by an angle about the vertical; at 0 the palm faces the camera.

        Returns:
            (size, size, 3) uint8 sRGB over `BACKGROUND`.
        """
        rgba = self._avatar.render(self._avatar.studio.posed(turn=degrees), self._camera)
        return as_uint8(rgba[..., :3] + (1.0 - rgba[..., 3:]) * (BACKGROUND / 255.0))


def turntable_frames(table: Turntable, angles: Sequence[float]) -> Iterator[np.ndarray]:
    """Draw the frames of a clip, with progress."""
    for angle in track(angles, "drawing the turntable"):
        yield table.view(angle)


def _facts(job: Job) -> dict[str, str]:
    look = (_VERSION, SIZE, FRAMES, FPS, BACKGROUND)
    return {"avatar": avatar_digest(job.folder), "look of the turntable": str(look)}


def _run(job: Job) -> None:
    table = Turntable(load_avatar(job.folder, hand=job.options.hand_model))
    angles = [360.0 * frame / FRAMES for frame in range(FRAMES)]
    write_movie(job.turntable, turntable_frames(table, angles), FPS)


TURNTABLE = Stage(
    name="turntable",
    title="Drawing the turntable",
    facts=_facts,
    result=lambda job: job.turntable,
    run=_run,
    expected=lambda job: _START + _FRAME * FRAMES,
)
