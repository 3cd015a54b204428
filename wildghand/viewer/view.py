"""The page on which an avatar is turned and posed: `wildghand view`, its pictures and its panel."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.base.console import notice
from hwp_bench.base.errors import UsageError
from hwp_bench.hands.skeleton import FINGERS, JOINT_NAMES, finger_joints
from hwp_bench.methods.contract import Camera
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.studio import ANGLES, REST
from wildghand.viewer.posed_view import (
    Motion,
    PageCamera,
    Picture,
    Player,
    PosedView,
    Viewpoint,
    shown_angles,
)
from wildghand.viewer.server import Address, require_viser, serving, url

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle, GuiApi, GuiEvent, GuiSliderHandle, ViserServer


#: Seconds that a picture may take while something moves: some ten pictures a second.
TARGET = 0.09
#: Smallest and largest edge of such a picture, px.
LEAST, MOST = 128, 768


class Pace:
    """Follows how long pictures take, and says how large the next one may be, px."""

    def __init__(self, edge: int = 256) -> None:
        self.edge = edge

    def took(self, edge: int, pixels: float, other: float) -> None:
        """Take note of a picture: its larger side in px, and its seconds."""
        # At least a third of the time goes to the pixels: smaller pictures would not help.
        left = max(TARGET - other, TARGET / 3)
        wanted = edge * math.sqrt(left / max(pixels, 1e-4))
        # Halfway, so that one slow picture on a busy machine does not make the next one tiny.
        self.edge = round(min(max(math.sqrt(self.edge * wanted), LEAST), MOST))


#: Seconds without a change after which the full picture is drawn.
SETTLE = 0.25
#: Quality of a draft's JPEG; full pictures are PNG.
DRAFT_QUALITY = 85

#: Draws what is to be seen now: (camera, whether it is a draft).
Draw = Callable[[Camera, bool], Picture]


@dataclass(eq=False)
class _Page:
    """One browser page. A version counts what changed for it."""

    client: ClientHandle
    camera: PageCamera
    pace: Pace = field(default_factory=Pace)
    version: int = 1
    drafted: int = 0
    finished: int = 0
    changed: float = 0.0


class Screen:
    """Keeps the picture of every page up to date, in a thread of its own.

    Args:
        server: whose pages they are.
        draw: called in that thread only.
        edge: largest edge of a full picture, px.

    Attributes:
        told: called after each picture, with it.
    """

    def __init__(self, server: ViserServer, draw: Draw, edge: int) -> None:
        self._draw, self._edge = draw, edge
        self.told: Callable[[Picture], None] = lambda picture: None
        self._pages: dict[int, _Page] = {}
        self._news = threading.Condition()
        self._ends = False
        self._start: Viewpoint | None = None
        server.on_client_connect(self._arrive)
        server.on_client_disconnect(self._leave)
        self._thread = threading.Thread(target=self._run, name="screen", daemon=True)
        self._thread.start()

    def touch(self) -> None:
        """Draw every page again: the hands, or what is behind them, have changed."""
        with self._news:
            for page in self._pages.values():
                self._change(page)

    def put_camera(self, viewpoint: Viewpoint) -> None:
        """Move the camera of every page, also of those that come later."""
        with self._news:
            self._start = viewpoint
            clients = [page.client for page in self._pages.values()]
        for client in clients:
            _move(client, viewpoint)

    @property
    def still(self) -> bool:
        """Whether every page has its full picture."""
        with self._news:
            return all(page.finished == page.version for page in self._pages.values())

    def stop(self) -> None:
        """End the thread."""
        with self._news:
            self._ends = True
            self._news.notify()
        self._thread.join(timeout=10.0)

    def _arrive(self, client: ClientHandle) -> None:
        page = _Page(client, _camera(client.camera))
        with self._news:
            self._pages[client.client_id] = page
            start = self._start
            self._change(page)

        @client.camera.on_update
        def _(camera: CameraHandle) -> None:
            with self._news:
                page.camera = _camera(camera)
                self._change(page)

        if start is not None:
            _move(client, start)

    def _leave(self, client: ClientHandle) -> None:
        with self._news:
            self._pages.pop(client.client_id, None)

    def _change(self, page: _Page) -> None:
        page.version += 1
        page.changed = time.monotonic()
        self._news.notify()

    def _run(self) -> None:
        while True:
            with self._news:
                while not self._ends and (job := self._next()) is None:
                    self._news.wait(self._pause())
                if self._ends:
                    return
            assert job is not None
            self._show(*job)

    def _next(self) -> tuple[_Page, bool] | None:
        """The page to draw, and whether a draft; None where nothing is to be drawn now."""
        for page in self._pages.values():
            if page.finished == page.version or not page.camera.sound():
                continue
            if time.monotonic() - page.changed >= SETTLE:
                return page, False
            if page.drafted != page.version:
                return page, True
        return None

    def _pause(self) -> float | None:
        """Seconds until a page has settled; None: until something changes."""
        waiting = [p for p in self._pages.values() if p.finished != p.version and p.camera.sound()]
        if not waiting:
            return None
        return max(0.0, min(p.changed for p in waiting) + SETTLE - time.monotonic())

    def _show(self, page: _Page, draft: bool) -> None:
        with self._news:
            version = page.version
        edge = min(page.pace.edge, self._edge) if draft else self._edge
        try:
            picture = self._draw(page.camera.camera(edge), draft)
            began = time.perf_counter()
            scene = page.client.scene
            if draft:
                scene.set_background_image(picture.image, format="jpeg", jpeg_quality=DRAFT_QUALITY)
                sent = time.perf_counter() - began
                page.pace.took(picture.edge, picture.pixels + sent, picture.other)
            else:
                scene.set_background_image(picture.image, format="png")
            self.told(picture)
        except Exception as error:  # one bad picture must not end the view
            notice(f"A picture could not be drawn ({type(error).__name__}: {error}).")
        with self._news:
            if draft:
                page.drafted = version
            else:
                page.drafted = page.finished = version
            # The others come first next time: while a motion plays, every page always waits.
            if self._pages.pop(page.client.client_id, None) is not None:
                self._pages[page.client.client_id] = page


def _camera(camera: CameraHandle) -> PageCamera:
    return PageCamera(
        camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height
    )


def _move(client: ClientHandle, viewpoint: Viewpoint) -> None:
    with client.atomic():
        client.camera.up_direction = viewpoint.up
        client.camera.position = viewpoint.position
        client.camera.look_at = viewpoint.look_at
        client.camera.fov = viewpoint.fov


#: Joints of each folder of sliders.
_FOLDERS = {"wrist": (0,), **{finger: finger_joints(finger) for finger in FINGERS}}


class Panel:
    """Everything that a person can change in the page of an avatar."""

    def __init__(
        self,
        gui: GuiApi,
        view: PosedView,
        put_camera: Callable[[Viewpoint], None],
        background: tuple[int, int, int],
    ) -> None:
        self._gui, self._view, self._put_camera = gui, view, put_camera
        self._sliders: dict[tuple[str, int, int], GuiSliderHandle[float]] = {}
        self._player: Player | None = None
        self._text = gui.add_markdown("")
        if view.motion is not None:
            with gui.add_folder("motion"):
                self._player = self._add_motion(view.motion.times)
        with gui.add_folder("pose"):
            self._add_poses()
        for side in view.angles:
            for folder, joints in _FOLDERS.items():
                name = folder if len(view.angles) == 1 else f"{side} {folder}"
                with gui.add_folder(name, expand_by_default=folder == "index"):
                    for joint in joints:
                        self._add_joint(side, joint)
        color = gui.add_rgb("background", background)
        color.on_update(lambda event: view.set_background(color.value))
        self.show_angles()

    def tell(self, picture: Picture) -> None:
        """Say how the picture was drawn."""
        height, width = picture.image.shape[:2]
        kind = "draft" if picture.draft else "full"
        seconds = picture.pixels + picture.other
        self._text.content = f"{width} x {height} px, {kind}, {1e3 * seconds:.0f} ms"

    def show_angles(self) -> None:
        """Set the sliders to the current angles of the hands."""
        for side, hand in self._view.hands.items():
            shown = shown_angles(hand, self._view.angles[side])
            for (of, joint, angle), slider in self._sliders.items():
                if of == side:
                    _put(slider, float(shown[joint, angle]))

    def stop(self) -> None:
        """End playback."""
        if self._player is not None:
            self._player.stop()

    def _add_joint(self, side: str, joint: int) -> None:
        angles = self._view.angles[side]
        for angle, name in enumerate(ANGLES):
            slider = self._gui.add_slider(
                f"{JOINT_NAMES[joint]} {name}",
                min=float(angles.lower[joint, angle]),
                max=float(angles.upper[joint, angle]),
                step=1.0,
                initial_value=0.0,
                hint="degrees from rest",
            )
            self._sliders[side, joint, angle] = slider

            def moved(event: GuiEvent[Any], angle: int = angle) -> None:
                # What this program sets has no client; the hands have it already.
                if event.client is not None:
                    degrees = event.target.value
                    self._pause()  # It puts the sliders back.
                    self._view.set_angle(side, joint, angle, degrees)
                    if event.target.value != degrees:
                        _put(event.target, degrees)

            slider.on_update(moved)

    def _add_poses(self) -> None:
        named = self._gui.add_dropdown("shape", self._view.names, initial_value=REST)

        @named.on_update
        def _(event: GuiEvent[Any]) -> None:
            if event.client is not None:
                self._pause()
                self._view.set_fingers(event.target.value)
                self.show_angles()

        @self._gui.add_button("upright at rest").on_click
        def _(event: GuiEvent[Any]) -> None:
            self._pause()
            self._view.rest()
            _put(named, REST)
            self.show_angles()
            self._put_camera(self._view.studio_viewpoint())

    def _add_motion(self, times: np.ndarray) -> Player:
        gui, view, count = self._gui, self._view, len(times)
        self._playing = gui.add_checkbox("play", False)
        frame = gui.add_slider("frame", min=0, max=max(count - 1, 1), step=1, initial_value=0)
        speed = gui.add_slider("speed", min=0.1, max=2.0, step=0.1, initial_value=1.0)

        def show(due: int) -> None:
            _put(frame, due)
            view.set_frame(due)

        player = Player(times, show)

        @self._playing.on_update
        def _(event: GuiEvent[Any]) -> None:
            if self._playing.value:
                player.play(frame.value)
            else:
                player.stop()
                self.show_angles()

        @frame.on_update
        def _(event: GuiEvent[Any]) -> None:
            if event.client is not None:
                due = min(event.target.value, count - 1)  # Playback moves the slider.
                self._pause()
                view.set_frame(due)
                self.show_angles()

        @speed.on_update
        def _(event: GuiEvent[Any]) -> None:
            player.speed = speed.value

        @gui.add_button("camera of the frame").on_click
        def _(event: GuiEvent[Any]) -> None:
            self._put_camera(view.frame_viewpoint(min(frame.value, count - 1)))

        return player

    def _pause(self) -> None:
        """Stop playback, so that it does not undo what a person changes."""
        if self._player is not None and self._playing.value:
            _put(self._playing, False)


def _put(handle: Any, value: Any) -> None:
    """Set what an element of the page shows; mypy takes viser's property for a read-only one."""
    handle.value = value


@dataclass(frozen=True)
class ViewSettings:
    """How a view looks."""

    #: Largest edge of a picture, px.
    edge: int = 1024
    #: Behind the hands at the start, sRGB, 0 to 255.
    background: tuple[int, int, int] = (255, 255, 255)

    def __post_init__(self) -> None:
        if not 64 <= self.edge <= 4096:
            raise UsageError(f"is {self.edge}", field="--size", remedy="Use 64 to 4096 px.")
        if not all(0 <= part <= 255 for part in self.background):
            raise UsageError(f"is {self.background}", field="--background", remedy="Use 0 to 255.")


@dataclass(frozen=True, eq=False)
class ServedView:
    """A view while it is served."""

    #: Where a browser opens it.
    url: str
    #: What it shows.
    view: PosedView
    #: Its pictures.
    screen: Screen
    #: Its web server.
    server: ViserServer


@contextlib.contextmanager
def serve_view(
    avatar: WildGHandAvatar,
    motion: Motion | None = None,
    address: Address | None = None,
    settings: ViewSettings | None = None,
) -> Iterator[ServedView]:
    """Serve a view while the block runs; without an address on this machine only."""
    require_viser()
    settings = settings or ViewSettings()
    view = PosedView(avatar, motion, settings.background)
    view.warm_up()
    with serving(address or Address(), "avatar") as server, contextlib.ExitStack() as closing:
        screen = Screen(server, view.draw, settings.edge)
        closing.callback(screen.stop)
        panel = Panel(server.gui, view, screen.put_camera, settings.background)
        closing.callback(panel.stop)
        screen.told, view.changed = panel.tell, screen.touch
        screen.put_camera(view.first_viewpoint())
        yield ServedView(url(server), view, screen, server)
