"""Drawing an avatar along the poses of a capture, to images and a video."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.console import track
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_folder, check_places
from hwp_bench.base.images import check_encoder, write_image, write_movie
from hwp_bench.capture import Capture
from wildghand.avatar.avatar import WildGHandAvatar


def render_clip(
    avatar: WildGHandAvatar,
    capture: Capture,
    frames: range,
    out: Path,
    *,
    background: int = 0,
    video: Path | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Draw frames into a folder, whole or not at all.

    Args:
        avatar: what is drawn.
        capture: whose hand parameters and cameras are used.
        frames: which of its frames.
        out: the folder.
        background: grey level behind the hand, 0 to 255.
        video: MP4 file (H.264) to write, too.
        overwrite: replace what exists.

    Returns:
        Number of frames, and frames drawn in a second.

    Raises:
        UsageError: the capture shows no hand that the avatar has, or belongs to another hand
            model; or the video lies in the folder, or the folder in the capture.
        MissingDependency: a video is asked for, and PyAV is not installed.
        HwpError: the video cannot be written.
    """
    check_places({"out": out, "video": video}, {"poses": capture.root}, replaces=overwrite)
    sides = shown_sides(avatar, capture)
    if video is not None:
        check_encoder()
    seconds, images = 0.0, []
    with atomic_folder(out, overwrite=overwrite, flag="--overwrite") as folder:
        for frame in track(frames, "Drawing"):
            poses, camera = capture.hand_poses(frame), capture.camera(frame)
            started = time.perf_counter()
            rgba = avatar.render({side: poses[side] for side in sides}, camera)
            seconds += time.perf_counter() - started
            behind = (1.0 - rgba[..., 3:]) * (background / 255.0)
            image = np.rint(255.0 * (rgba[..., :3] + behind)).clip(0, 255).astype(np.uint8)
            write_image(folder / f"{frame:06d}.png", image)
            if video is not None:
                images.append(image)
        if video is not None:
            # Within the block: where the video cannot be written, no folder refuses the next start.
            write_movie(video, images, capture.info.fps)
    return {"frames": len(frames), "frames_per_second": len(frames) / max(seconds, 1e-9)}


def shown_sides(avatar: WildGHandAvatar, capture: Capture) -> list[str]:
    """Return the hands of a capture that an avatar has.

    Raises:
        UsageError: there are none, or the capture belongs to another hand model.
    """
    sides = [side for side in capture.info.sides if side in avatar.sides]
    if not sides:
        raise UsageError(
            f"shows the {' and '.join(capture.info.sides)} hand, the avatar is of the "
            f"{' and '.join(avatar.sides)} hand",
            where=capture.root,
        )
    if capture.info.hand_model.name != avatar.hand_model.name:
        raise UsageError(
            f"has parameters of the hand model {capture.info.hand_model.name}, "
            f"the avatar takes those of {avatar.hand_model.name}",
            where=capture.root,
            remedy="Convert them with `hwp-bench hands convert`.",
        )
    return sides
