"""The stages that show an avatar: turned around, on a contact sheet, and on a page."""

# Methods of a stage are described where `Stage` declares them.
# ruff: noqa: D102

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import track
from hwp_bench.base.drawing import fitted, labelled, sheet
from hwp_bench.base.files import sha256_of
from hwp_bench.base.images import as_uint8, read_gray, write_image, write_movie
from hwp_bench.capture import Capture, open_capture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import DESCRIPTION, MODEL, WEIGHTS, load_avatar
from wildghand.from_video.job import Job
from wildghand.from_video.run import Stage
from wildghand.page import write_page

#: Edge of the turntable, px; frames of one turn, and in a second.
SIZE, FRAMES, FPS = 480, 96, 24
#: sRGB grey behind the hand.
BACKGROUND = 28
#: Columns of the sheet, and edge of its pictures, px.
COLUMNS, EDGE = 6, 256


class Turntable:
    """Draws an avatar at rest from all around (`wildghand.avatar.studio`).

    Args:
        avatar: what is drawn; two hands stand next to each other and turn together.
        size: edge of the square pictures, px.
    """

    def __init__(self, avatar: WildGHandAvatar, size: int) -> None:
        self._avatar = avatar
        self._camera = avatar.studio.camera(size, size)

    def view(self, degrees: float) -> np.ndarray:
        """Draw it turned about the vertical, (size, size, 3) uint8; at 0 the palm is in front."""
        rgba = self._avatar.render(self._avatar.studio.posed(turn=degrees), self._camera)
        return as_uint8(rgba[..., :3] + (1.0 - rgba[..., 3:]) * (BACKGROUND / 255.0))


def avatar_sheet(avatar: WildGHandAvatar, capture: Capture, weights: Path) -> np.ndarray:
    """Draw the sheet of an avatar that was fitted to a capture, (H, W, 3) uint8.

    In rows of `COLUMNS`: frames, evenly spaced among those that were fitted; the avatar in their
    poses; how much each pixel counted in the fit, white for most, where the folder `weights` has
    masks; the avatar at rest, turned in steps.
    """
    masks = {int(path.stem): path for path in sorted(weights.glob("[0-9]*.png"))}
    fitted_frames = sorted(masks) or avatar.record.frames
    frames = [fitted_frames[pick] for pick in evenly(len(fitted_frames), COLUMNS)]
    rows: list[list[np.ndarray]] = [[], [], []]
    video = capture.info.source.get("video")
    ends_early = isinstance(video, Mapping) and video.get("ends_early") is True
    for frame in frames:
        poses = {s: p for s, p in capture.hand_poses(frame).items() if s in avatar.sides}
        last = " (video ends early)" if ends_early and frame == frames[-1] else ""
        rows[0].append(_tile(capture.frame(frame), f"frame {frame}{last}"))
        drawn = avatar.render(poses, capture.camera(frame))[..., :3]
        rows[1].append(_tile(as_uint8(drawn), "avatar"))
        if frame in masks:
            gray = read_gray(masks[frame], capture.size)
            rows[2].append(_tile(np.repeat(gray[:, :, None], 3, axis=2), "weights"))
    table = Turntable(avatar, EDGE)
    angles = [360.0 * step / COLUMNS for step in range(COLUMNS)]
    rows.append([_tile(table.view(angle), f"turned {angle:.0f} degrees") for angle in angles])
    blank = np.full_like(rows[3][0], 250)
    tiles = [tile for row in rows if row for tile in [*row, *[blank] * (COLUMNS - len(row))]]
    return sheet(tiles, COLUMNS)


def _tile(image: np.ndarray, text: str) -> np.ndarray:
    return labelled(fitted(image, EDGE), text)


def avatar_digest(folder: Path) -> str:
    """One digest of an avatar's tensors and description."""
    return sha256_of(folder / MODEL) + sha256_of(folder / DESCRIPTION)


class _Picture(Stage):
    """A stage that shows the avatar; its version rises when the picture comes out otherwise."""

    def facts(self, job: Job) -> dict[str, str]:
        return {"avatar": avatar_digest(job.folder), f"look of the {self.name}": self.look()}

    def look(self) -> str:
        """Everything that the picture depends on, besides the avatar."""
        raise NotImplementedError

    def run(self, job: Job) -> None:
        self.show(job, load_avatar(job.folder, hand=job.options.hand_model))

    def show(self, job: Job, avatar: WildGHandAvatar) -> None:
        """Write the picture."""
        raise NotImplementedError


class DrawTurntable(_Picture):
    """The avatar from all around, as it stands in its studio."""

    name, title = "turntable", "Drawing the turntable"

    def look(self) -> str:
        return str((2, SIZE, FRAMES, FPS, BACKGROUND))

    def result(self, job: Job) -> Path:
        return job.turntable

    def show(self, job: Job, avatar: WildGHandAvatar) -> None:
        table = Turntable(avatar, SIZE)
        angles = track([360.0 * frame / FRAMES for frame in range(FRAMES)], "drawing the turntable")
        write_movie(job.turntable, (table.view(angle) for angle in angles), FPS)

    def expected(self, job: Job) -> float:
        return 4.0 + 0.1 * FRAMES


class DrawSheet(_Picture):
    """The contact sheet: frames, the avatar in their poses, its weights, and all of its sides."""

    name, title = "sheet", "Drawing the contact sheet"

    def look(self) -> str:
        return str((1, COLUMNS, EDGE))

    def result(self, job: Job) -> Path:
        return job.sheet

    def show(self, job: Job, avatar: WildGHandAvatar) -> None:
        drawn = avatar_sheet(avatar, open_capture(job.capture), job.folder / WEIGHTS)
        write_image(job.sheet, drawn)

    def expected(self, job: Job) -> float:
        return 6.0


class WritePage(_Picture):
    """The avatar's page: one file that turns and poses it in a browser."""

    name, title = "page", "Writing the page"

    def look(self) -> str:
        return "1"

    def result(self, job: Job) -> Path:
        return job.page

    def show(self, job: Job, avatar: WildGHandAvatar) -> None:
        write_page(avatar, job.page, capture=open_capture(job.capture), overwrite=True)

    def expected(self, job: Job) -> float:
        return 15.0
