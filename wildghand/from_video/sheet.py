"""The contact sheet: frames, the avatar in their poses, its weights, and all of its sides."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.drawing import fitted, labelled, sheet
from hwp_bench.base.images import as_uint8, read_gray, write_image
from hwp_bench.capture import Capture, open_capture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import WEIGHTS, load_avatar
from wildghand.from_video.fit import avatar_digest
from wildghand.from_video.job import Job
from wildghand.from_video.stage import Stage
from wildghand.from_video.turntable import Turntable

#: Columns of the sheet, and edge of its pictures, px.
COLUMNS, EDGE = 6, 256
# Raises when the sheet comes out otherwise, so that an older one is drawn again.
_VERSION = 1
# Seconds that it takes.
_SECONDS = 6.0


def avatar_sheet(avatar: WildGHandAvatar, capture: Capture, weights: Path) -> np.ndarray:
    """Draw the sheet of an avatar.

    Args:
        avatar: what is drawn.
        capture: what it was fitted to.
        weights: folder of its weight masks by frame; it may be missing.

    Returns:
        (H, W, 3) uint8. In rows of `COLUMNS`: frames, evenly spaced among those that were fitted;
        the avatar in their poses; how much each pixel counted in the fit, white for most, where
        the masks are; the avatar at rest, turned in steps.
    """
    masks = {int(path.stem): path for path in sorted(weights.glob("[0-9]*.png"))}
    frames = _spread(sorted(masks) or avatar.record.frames)
    rows: list[list[np.ndarray]] = [[], [], []]
    video = capture.info.source.get("video")
    ends_early = isinstance(video, Mapping) and video.get("ends_early") is True
    for frame in frames:
        poses = {s: p for s, p in capture.hand_poses(frame).items() if s in avatar.sides}
        rows[0].append(_tile(capture.frame(frame), _named(frame, frames, ends_early)))
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


def _named(frame: int, frames: list[int], ends_early: bool) -> str:
    return f"frame {frame}" + (" (video ends early)" if ends_early and frame == frames[-1] else "")


def _spread(frames: list[int]) -> list[int]:
    return [frames[pick] for pick in evenly(len(frames), COLUMNS)]


def _tile(image: np.ndarray, text: str) -> np.ndarray:
    return labelled(fitted(image, EDGE), text)


def _facts(job: Job) -> dict[str, str]:
    look = (_VERSION, COLUMNS, EDGE)
    return {"avatar": avatar_digest(job.folder), "look of the sheet": str(look)}


def _run(job: Job) -> None:
    avatar = load_avatar(job.folder, hand=job.options.hand_model)
    write_image(job.sheet, avatar_sheet(avatar, open_capture(job.capture), job.folder / WEIGHTS))


SHEET = Stage(
    name="sheet",
    title="Drawing the contact sheet",
    facts=_facts,
    result=lambda job: job.sheet,
    run=_run,
    expected=lambda job: _SECONDS,
)
