"""The page on which an avatar is turned and posed: `wildghand view`, and its panel."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hwp_bench.base.errors import UsageError
from hwp_bench.hands.skeleton import FINGERS, JOINT_NAMES, finger_joints
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.studio import ANGLES, REST
from wildghand.viewer.posed_view import Motion, Picture, Player, PosedView, Viewpoint, shown_angles
from wildghand.viewer.screen import Screen
from wildghand.viewer.server import Address, require_viser, serving, url

if TYPE_CHECKING:
    from viser import GuiApi, GuiEvent, GuiSliderHandle, ViserServer


#: Joints of each folder of sliders.
_FOLDERS = {"wrist": (0,), **{finger: finger_joints(finger) for finger in FINGERS}}


class Panel:
    """Everything that a person can change in the page of an avatar.

    Args:
        gui: of the page.
        view: what is changed.
        put_camera: moves the camera of the page.
        background: sRGB, 0 to 255, at the start.
    """

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
                self._player = self._add_motion(len(view.motion), view.motion.fps)
        with gui.add_folder("pose"):
            self._add_poses()
        for side in view.hands:
            for folder, joints in _FOLDERS.items():
                name = folder if len(view.hands) == 1 else f"{side} {folder}"
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
        """Bring the sliders to the hands as they are."""
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
                    self._pause()
                    self._view.set_angle(side, joint, angle, event.target.value)

            slider.on_update(moved)

    def _add_poses(self) -> None:
        named = self._gui.add_dropdown("shape", self._view.names, initial_value=REST)

        @named.on_update
        def _(event: GuiEvent[Any]) -> None:
            if event.client is not None:
                self._pause()
                self._view.set_fingers(named.value)
                self.show_angles()

        @self._gui.add_button("upright at rest").on_click
        def _(event: GuiEvent[Any]) -> None:
            self._pause()
            self._view.rest()
            _put(named, REST)
            self.show_angles()
            self._put_camera(self._view.studio_viewpoint())

    def _add_motion(self, count: int, fps: float) -> Player:
        gui, view = self._gui, self._view
        self._playing = gui.add_checkbox("play", False)
        frame = gui.add_slider("frame", min=0, max=max(count - 1, 1), step=1, initial_value=0)
        speed = gui.add_slider("speed", min=0.1, max=2.0, step=0.1, initial_value=1.0)

        def show(due: int) -> None:
            _put(frame, due)
            view.set_frame(due)

        player = Player(count, fps, show)

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
                self._pause()
                view.set_frame(min(frame.value, count - 1))
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
