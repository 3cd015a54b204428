"""The state of a view of an avatar: its hands, the background, and how they are drawn."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable

import numpy as np

from hwp_bench.methods.contract import Camera
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.viewer.cameras import Viewpoint, viewpoint
from wildghand.viewer.motion import Motion
from wildghand.viewer.painter import Painter, Picture
from wildghand.viewer.posing import Hands, with_angle, with_fingers

#: Edge of the picture that gets everything compiled before a page asks, px.
_FIRST_EDGE = 64
# How far a page's camera stands behind the studio's, as a share of the distance.
_BACK = 0.3


class PosedView:
    """An avatar that is posed from several threads and drawn in one.

    Args:
        avatar: what is drawn.
        motion: what is played; the view begins with its first frame. None: the hands begin at rest.
        background: sRGB, 0 to 255.

    Attributes:
        changed: called after each change.
    """

    def __init__(
        self,
        avatar: WildGHandAvatar,
        motion: Motion | None = None,
        background: tuple[int, int, int] = (255, 255, 255),
    ) -> None:
        self.avatar, self.motion = avatar, motion
        self.angles = avatar.studio.angles
        self._named = {side: angles.named_poses() for side, angles in self.angles.items()}
        self.names = tuple(next(iter(self._named.values())))
        self.changed: Callable[[], None] = lambda: None
        self._painter, self._lock = Painter(avatar), threading.Lock()
        self._background = background
        self._hands: Hands = avatar.studio.posed() if motion is None else motion.hands(0)

    @property
    def hands(self) -> Hands:
        """The hands as they are now; never changed in place."""
        return self._hands

    def warm_up(self) -> None:
        """Compile what pictures need."""
        camera = self.avatar.studio.camera(_FIRST_EDGE, _FIRST_EDGE)
        self.draw(camera, True)
        self.draw(camera, False)

    def draw(self, camera: Camera, draft: bool) -> Picture:
        """Draw the hands as they are now."""
        with self._lock:
            hands, background = self._hands, self._background
        draw = self._painter.draft if draft else self._painter.full
        return draw(hands, camera, background)

    def set_angle(self, side: str, joint: int, angle: int, degrees: float) -> None:
        """Change an angle; see `with_angle`."""
        self._change(lambda hands: with_angle(hands, self.angles[side], joint, angle, degrees))

    def set_fingers(self, name: str) -> None:
        """Give every hand the fingers of a named pose."""
        named = {side: poses[name] for side, poses in self._named.items()}
        self._change(lambda hands: with_fingers(hands, self.angles, named))

    def set_frame(self, frame: int) -> None:
        """Show the hands of a frame of the motion."""
        assert self.motion is not None
        hands = self.motion.hands(frame)
        self._change(lambda _: hands)

    def rest(self) -> None:
        """Put the hands at rest, upright before the first camera."""
        hands = self.avatar.studio.posed()
        self._change(lambda _: hands)

    def set_background(self, color: tuple[int, int, int]) -> None:
        """Change the colour behind the hands, sRGB, 0 to 255."""
        with self._lock:
            self._background = color
        self.changed()

    def studio_viewpoint(self) -> Viewpoint:
        """Where a camera sees the hands at rest, with room for the panel next to them."""
        studio = self.avatar.studio
        place = viewpoint(studio.camera(_FIRST_EDGE, _FIRST_EDGE), studio.centre)
        back = _BACK * (place.look_at - place.position)
        return dataclasses.replace(place, position=place.position - back)

    def frame_viewpoint(self, frame: int) -> Viewpoint:
        """Where the camera of a frame stood."""
        assert self.motion is not None
        places = [hand.transl for hand in self.motion.hands(frame).values()]
        return viewpoint(self.motion.camera(frame), np.mean(places, axis=0))

    def first_viewpoint(self) -> Viewpoint:
        """Where the view begins."""
        return self.studio_viewpoint() if self.motion is None else self.frame_viewpoint(0)

    def _change(self, change: Callable[[Hands], Hands]) -> None:
        with self._lock:
            self._hands = change(self._hands)
        self.changed()
