"""An avatar that is posed and drawn for a page: cameras, motion, pictures, and their state.

The camera of a page and ours are both pinholes with OpenCV axes.
"""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hwp_bench.capture import Capture
from hwp_bench.capture.schema import METADATA
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar, over, splat
from wildghand.avatar.render import hands_of, shown_sides
from wildghand.avatar.studio import HandAngles


@dataclass(frozen=True, eq=False)
class PageCamera:
    """The camera of a page, as last reported."""

    #: (4,) (w, x, y, z), camera to world.
    wxyz: np.ndarray
    #: (3,) m, world.
    position: np.ndarray
    #: Vertical field of view, rad.
    fov: float
    #: Of the page's picture, px.
    width: int
    #: Of the page's picture, px.
    height: int

    def sound(self) -> bool:
        """Whether a picture can be drawn for it: a page's numbers are not ours."""
        numbers = [*np.ravel(self.wxyz), *np.ravel(self.position), self.fov]
        return (
            all(math.isfinite(number) for number in numbers)
            and float(np.linalg.norm(self.wxyz)) > 1e-6
            and 0.01 < self.fov < 3.1
            and min(self.width, self.height) >= 1
            and max(self.width, self.height) < 100 * min(self.width, self.height)
        )

    def camera(self, edge: int) -> Camera:
        """Return our camera for a picture whose larger side is at most `edge` px.

        The picture has the page's shape up to a pixel, and is never larger than the page's own.
        """
        scale = min(1.0, edge / max(self.width, self.height))
        width = max(1, round(scale * self.width))
        height = max(1, round(scale * self.height))
        # The page stretches the picture to its own shape, so each axis has a focal length.
        focal = 0.5 / math.tan(0.5 * self.fov)
        x = focal * self.height * width / self.width
        K = np.array([[x, 0.0, 0.5 * width], [0.0, focal * height, 0.5 * height], [0, 0, 1.0]])
        w, x, y, z = np.asarray(self.wxyz, dtype=np.float64)
        turn = Rotation.from_quat([x, y, z, w]).inv().as_matrix()
        viewmat = np.eye(4)
        viewmat[:3, :3] = turn
        viewmat[:3, 3] = -turn @ np.asarray(self.position, dtype=np.float64)
        return Camera(K, viewmat, width, height)


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Where a page's camera is put."""

    #: (3,) m, world.
    position: np.ndarray
    #: (3,) m, the point that it looks at and turns about.
    look_at: np.ndarray
    #: (3,) direction that is up in the picture.
    up: np.ndarray
    #: Vertical field of view, rad.
    fov: float


def viewpoint(camera: Camera, centre: np.ndarray) -> Viewpoint:
    """Return the viewpoint of one of our cameras.

    Args:
        centre: (3,) m, world, about what the page's camera turns; the nearest point to it on the
            camera's axis is taken, so that the picture stays the camera's.
    """
    turn, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    position, ahead = -turn.T @ shift, turn[2]
    depth = max(float((np.asarray(centre) - position) @ ahead), 1e-2)
    fov = 2.0 * math.atan(0.5 * camera.height / float(camera.K[1, 1]))
    return Viewpoint(position, position + depth * ahead, -turn[1], fov)


class Motion:
    """The motion of a capture, for the hands that an avatar has."""

    def __init__(self, avatar: WildGHandAvatar, capture: Capture) -> None:
        self._avatar, self._capture = avatar, capture
        shown_sides(avatar, capture)  # refuses a capture of other hands
        #: (F,) s, when each frame was recorded.
        self.times = capture.info.frame_times()

    def __len__(self) -> int:
        return self._capture.info.frame_count

    def hands(self, frame: int) -> dict[str, HandPose]:
        """The hands of a frame by side; see `hands_of`."""
        return hands_of(self._avatar, self._capture, frame)

    def camera(self, frame: int) -> Camera:
        """The camera of a frame."""
        return self._capture.camera(frame)


def capture_of(avatar: Path) -> Path | None:
    """Return the capture folder that lies with an avatar folder, as a fit of a video leaves it."""
    folder = avatar / "work" / "capture"
    return folder if (folder / METADATA).is_file() else None


#: Hands as they are shown, by side.
Hands = Mapping[str, HandPose]


def shown_angles(hand: HandPose, angles: HandAngles) -> np.ndarray:
    """(16, 3) degrees of a hand as sliders show them.

    They are rounded to a tenth and within the ranges: a tracked pose may lie outside of them.
    """
    return np.round(angles.angles(hand.pose), 1).clip(angles.lower, angles.upper)


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture and what it cost."""

    #: (H, W, 3) uint8 sRGB.
    image: np.ndarray
    #: Whether it is a draft.
    draft: bool
    #: Seconds that went into its pixels.
    pixels: float
    #: Seconds that went into everything else.
    other: float

    @property
    def edge(self) -> int:
        """Its larger side, px."""
        return max(self.image.shape[:2])


class Player:
    """Goes round and round from frame to frame; where showing is slower, frames are left out.

    Args:
        times: (F,) s, when each frame was recorded, rising from 0.
        show: shows a frame.
    """

    def __init__(self, times: np.ndarray, show: Callable[[int], None]) -> None:
        self._times, self._show = times, show
        self._step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
        #: Times the speed of the clip.
        self.speed = 1.0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def play(self, frame: int) -> None:
        """Begin at a frame; does nothing while it plays."""
        if self._thread is None:
            self._stop.clear()
            self._thread = threading.Thread(target=self._run, args=(frame,), daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Stop, and wait until it has."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._stop.set()
            thread.join(timeout=10.0)

    def _run(self, frame: int) -> None:
        moment, before = float(self._times[frame]), time.monotonic()
        period = float(self._times[-1]) + self._step
        while not self._stop.wait(self._step):
            now = time.monotonic()
            moment, before = (moment + (now - before) * self.speed) % period, now
            self._show(int(np.searchsorted(self._times, moment, side="right")) - 1)


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
        hands: as they are now, by side; never changed in place.
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
        self._lock, self._background = threading.Lock(), background
        self.hands: Hands = avatar.studio.posed() if motion is None else motion.hands(0)
        self._posed: tuple[Hands, PosedGaussians] | None = None

    def warm_up(self) -> None:
        """Compile what pictures need."""
        camera = self.avatar.studio.camera(_FIRST_EDGE, _FIRST_EDGE)
        self.draw(camera, True)
        self.draw(camera, False)

    def draw(self, camera: Camera, draft: bool) -> Picture:
        """Draw the hands as they are now, with the rasterizer that fits and scores the avatar.

        A draft leaves out what depends on the camera (the light of normals that no frame has
        shown), and keeps the Gaussians for as long as the hands stay: turning the camera costs
        pixels only.
        """
        began = time.perf_counter()
        with self._lock:
            hands, background = self.hands, self._background
        if not draft:
            image = over(self.avatar.render(hands, camera), background)
            return Picture(image, False, time.perf_counter() - began, 0.0)
        if self._posed is None or self._posed[0] is not hands:
            self._posed = hands, self.avatar.pose(hands, closed=True)
        entered = time.perf_counter()
        image = over(splat(self._posed[1], camera, self.avatar.device), background)
        return Picture(image, True, time.perf_counter() - entered, entered - began)

    def set_angle(self, side: str, joint: int, angle: int, degrees: float) -> None:
        """Change an angle, cut to the range of the joint; everything else stays."""
        angles = self.angles[side]
        least, most = angles.lower[joint, angle], angles.upper[joint, angle]

        def change(hands: Hands) -> Hands:
            if side not in hands:  # The capture shows the other hand alone.
                return hands
            found = angles.angles(hands[side].pose)
            found[joint, angle] = np.clip(degrees, least, most)
            return {**hands, side: dataclasses.replace(hands[side], pose=angles.pose(found))}

        self._change(change)

    def set_fingers(self, name: str) -> None:
        """Give every hand the fingers of a named pose, where it is and as it is turned."""

        def change(hands: Hands) -> Hands:
            changed = {}
            for side, hand in hands.items():
                pose = self.angles[side].pose(self._named[side][name])
                pose[0] = hand.pose[0]
                changed[side] = dataclasses.replace(hand, pose=pose)
            return changed

        self._change(change)

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
            self.hands = change(self.hands)
        self.changed()
