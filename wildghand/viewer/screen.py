"""The pictures behind a page: drafts while something moves, the full picture when it is still."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hwp_bench.base.console import notice
from hwp_bench.methods.contract import Camera
from wildghand.viewer.posed_view import PageCamera, Picture, Viewpoint

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle, ViserServer


#: Seconds that a picture may take while something moves: some ten pictures a second.
TARGET = 0.09
#: Smallest and largest edge of such a picture, px.
LEAST, MOST = 128, 768


class Pace:
    """Follows how long pictures take, and says how large the next one may be.

    Args:
        edge: of the first picture, px.
    """

    def __init__(self, edge: int = 256) -> None:
        self.edge = edge

    def took(self, edge: int, pixels: float, other: float) -> None:
        """Take note of a picture.

        Args:
            edge: its larger side, px.
        """
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
