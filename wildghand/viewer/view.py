"""The page on which an avatar is turned and posed: `wildghand view`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hwp_bench.base.errors import UsageError
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.viewer.motion import Motion
from wildghand.viewer.panel import Panel
from wildghand.viewer.posed_view import PosedView
from wildghand.viewer.screen import Screen
from wildghand.viewer.server import Address, require_viser, serving, url

if TYPE_CHECKING:
    from viser import ViserServer


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
    """Serve a view while the block runs.

    Args:
        avatar: what is shown.
        motion: what is played.
        address: where it is served; None: on this machine only.
        settings: how it looks.

    Raises:
        MissingDependency: viser is not installed.
        UsageError: the address cannot be used.
    """
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
