"""A fit that is watched in the browser while it runs: `wildghand fit --live`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from hwp_bench.base.drawing import PAPER, fitted, labelled
from hwp_bench.importers.video.glimpse import Glimpse, PaintedHand
from wildghand.fitting.glance import LEAST_PAUSE, Glance, Live
from wildghand.viewer.server import Address, serving, url

if TYPE_CHECKING:
    from viser import ClientHandle, GlbHandle, ViserServer


#: Larger side of each of the four pictures, px.
TILE = 384
_GAP = 8


def live_sheet(look: Glance, aspect: float) -> np.ndarray:
    """Draw the four pictures of a preview on a sheet, (H, W, 3) uint8; W is `aspect` times H."""
    names = (f"frame {look.frame}", f"avatar, {look.psnr:.1f} dB", "turned", "weights of pixels")
    weights = np.repeat(look.weights[..., None], 3, axis=2)
    pictures = (look.truth, look.avatar, look.turned, weights)
    room = ((_GAP, _GAP), (_GAP, _GAP), (0, 0))
    tiles = [
        np.pad(labelled(fitted(image, TILE), name), room, constant_values=PAPER[0])
        for image, name in zip(pictures, names, strict=True)
    ]
    pairs = [np.concatenate(tiles[first : first + 2], axis=1) for first in (0, 2)]
    laid = [*(np.concatenate(tiles, axis=axis) for axis in (1, 0)), np.concatenate(pairs)]
    inner = max(laid, key=lambda whole: min(aspect / whole.shape[1], 1.0 / whole.shape[0]))
    height, width = inner.shape[:2]
    full = max(height, round(width / aspect)), max(width, round(height * aspect))
    top, left = (full[0] - height) // 2, (full[1] - width) // 2
    page = np.full((*full, 3), PAPER, dtype=np.uint8)
    page[top : top + height, left : left + width] = inner
    return page


#: Points of the chart; of more, every second one is dropped.
_POINTS = 400
# What the metres of a hand are multiplied by: the page's camera stands some units away.
_ENLARGED = 15.0


class LivePage:
    """The page of a fit: numbers, a chart, and the pictures of one training frame."""

    def __init__(self, server: ViserServer) -> None:
        import viser.uplot

        self._server = server
        self._last: Glance | None = None
        self._curve: list[tuple[float, float, float]] = []
        self._text = server.gui.add_markdown("The fit is being prepared.")
        self._meshes: list[GlbHandle] = []
        server.initial_camera.position, server.initial_camera.look_at = (0.0, -4.0, 0.0), (0.0,) * 3
        self._share = server.gui.add_slider(
            "training frame", min=0, max=100, step=1, initial_value=0, hint="% of the clip"
        )
        plot = viser.uplot
        series = (
            plot.Series(label="step"),
            plot.Series(label="loss", stroke="#1864ab", scale="loss"),
            plot.Series(label="PSNR, dB", stroke="#d9480f", scale="dB"),
        )
        scale = plot.Scale(auto=True)
        axes = plot.Axis(label="step"), plot.Axis(scale="loss"), plot.Axis(scale="dB", side=1)
        self._chart = server.gui.add_uplot(
            (np.zeros(1), np.zeros(1), np.zeros(1)),
            series,
            scales={"x": plot.Scale(time=False), "loss": scale, "dB": scale},
            axes=axes,
            aspect=1.4,
        )
        server.on_client_connect(self._arrive)

    def row(self, count: int) -> int:
        """Return which of `count` training frames the page asks for."""
        return min(count - 1, self._share.value * count // 100)

    def wanted(self) -> bool:
        """Whether a page is open."""
        return bool(self._server.get_clients())

    def show_hands(self, hands: Sequence[PaintedHand]) -> None:
        """Show hands as an import has fitted them so far; the mouse turns them."""
        middle = np.concatenate([hand.vertices for hand in hands]).mean(axis=0)
        for mesh in self._meshes:
            mesh.remove()
        self._meshes.clear()
        for number, hand in enumerate(hands):
            # The camera looks along z with y down; the page's vertical is z.
            x, y, z = (_ENLARGED * (hand.vertices - middle)).T
            places = np.stack([x, z, -y], axis=1)
            solid = trimesh.Trimesh(places, hand.faces, vertex_colors=hand.colors, process=False)
            self._meshes.append(self._server.scene.add_mesh_trimesh(f"hand{number}", solid))
        self._text.content = "The hand as the import has fitted it so far. The mouse turns it."

    def show(self, look: Glance) -> None:
        """Bring every page up to date."""
        while self._meshes:
            self._meshes.pop().remove()
        self._last = look
        self._curve.append((float(look.step), look.loss, look.psnr))
        if len(self._curve) > _POINTS:
            self._curve = self._curve[::2]
        self._text.content = (
            f"step **{look.step}**, loss **{look.loss:.4f}**, frame {look.frame}: "
            f"**{look.psnr:.1f} dB**"
        )
        steps, losses, psnrs = np.array(self._curve).T
        self._chart.data = steps, losses, psnrs
        for client in self._server.get_clients().values():
            _draw(client, look)

    def _arrive(self, client: ClientHandle) -> None:
        if self._last is not None:
            _draw(client, self._last)


def _draw(client: ClientHandle, look: Glance) -> None:
    width, height = client.camera.image_width, client.camera.image_height
    aspect = min(max(width / max(height, 1), 0.1), 10.0)
    client.scene.set_background_image(live_sheet(look, aspect), format="png")


@dataclass(frozen=True, eq=False)
class ServedFit:
    """The page of a fit while it is served."""

    #: Where a browser opens it.
    url: str
    #: What a fit calls after each step.
    watch: Live
    #: What an import calls, before it.
    glimpse: Glimpse
    #: Its web server.
    server: ViserServer


@contextlib.contextmanager
def serve_fit(address: Address | None = None, pause: float = LEAST_PAUSE) -> Iterator[ServedFit]:
    """Serve the page of a fit while the block runs; without an address on this machine only."""
    with serving(address or Address(), "fit") as server:
        page = LivePage(server)
        watch = Live(page.show, page.wanted, page.row, pause)
        yield ServedFit(url(server), watch, page.show_hands, server)
