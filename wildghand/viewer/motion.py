"""The hands of a clip, frame by frame, as a view plays them."""

from __future__ import annotations

from pathlib import Path

from hwp_bench.capture import Capture
from hwp_bench.capture.schema import METADATA
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.playback import shown_sides


class Motion:
    """The motion of a capture, for the hands that an avatar has.

    Args:
        avatar: what moves.
        capture: whose hand parameters and cameras are used.

    Raises:
        UsageError: the capture shows no hand that the avatar has, or belongs to another hand
            model.
    """

    def __init__(self, avatar: WildGHandAvatar, capture: Capture) -> None:
        self._avatar, self._capture = avatar, capture
        self._sides = shown_sides(avatar, capture)
        self.fps = capture.info.fps

    def __len__(self) -> int:
        return self._capture.info.frame_count

    def hands(self, frame: int) -> dict[str, HandPose]:
        """Return the hands of a frame, by side, in the poses that the avatar believes in."""
        poses = self._avatar.believed(self._capture.hand_poses(frame))
        return {side: poses[side] for side in self._sides}

    def camera(self, frame: int) -> Camera:
        """Return the camera of a frame."""
        return self._capture.camera(frame)


def capture_of(avatar: Path) -> Path | None:
    """Return the capture folder that lies with an avatar folder, as a fit of a video leaves it."""
    for folder in (avatar / "work" / "capture", avatar.with_name(avatar.name + ".capture")):
        if (folder / METADATA).is_file():
            return folder
    return None
