"""The parts of a view that need no browser. Oracles: projections, the avatar's own drawing."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_fits import TINY

import wildghand
from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Camera
from wildghand.avatar.avatar import WildGHandAvatar, over
from wildghand.fitting.glance import Glance
from wildghand.viewer.live import live_sheet
from wildghand.viewer.posed_view import (
    Motion,
    PageCamera,
    Picture,
    Player,
    PosedView,
    capture_of,
    shown_angles,
    viewpoint,
)
from wildghand.viewer.server import refusal
from wildghand.viewer.view import LEAST, MOST, TARGET, Pace, Panel, Screen


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """dB between two 8-bit pictures."""
    return -10.0 * np.log10(np.square((first.astype(float) - second) / 255.0).mean() + 1e-12)


def look_from(camera: Camera, centre: np.ndarray, edge: int) -> Camera:
    """The camera that a page has after it was put at the viewpoint of another."""
    place = viewpoint(camera, centre)
    ahead = place.look_at - place.position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, place.up)
    axes = np.stack([right, -place.up, ahead], axis=1)
    x, y, z, w = Rotation.from_matrix(axes).as_quat()
    page = PageCamera(
        np.array([w, x, y, z]), place.position, place.fov, camera.width, camera.height
    )
    assert page.sound()
    return page.camera(edge)


def a_camera(seed: int) -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    viewmat[:3, 3] = np.random.default_rng(seed).normal(0.0, 0.3, 3)
    K = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
    return Camera(K, viewmat, 320, 240)


@given(seed=st.integers(0, 1000))
def test_a_page_at_the_viewpoint_of_a_camera_sees_what_it_saw(seed: int) -> None:
    camera = a_camera(seed)
    found = look_from(camera, np.zeros(3), 320)
    np.testing.assert_allclose(found.viewmat, camera.viewmat, atol=1e-9)
    np.testing.assert_allclose(found.K, camera.K, atol=1e-6)
    assert (found.width, found.height) == (320, 240)


@given(width=st.integers(1, 4000), height=st.integers(50, 3000), edge=st.integers(64, 4000))
def test_smaller_pictures_show_the_same_part_of_the_world(
    width: int, height: int, edge: int
) -> None:
    page = PageCamera(np.array([1.0, 0, 0, 0]), np.zeros(3), 0.7, width, height)
    camera = page.camera(edge)
    assert max(camera.width, camera.height) <= min(edge, max(width, height))
    # The corner of the page is the corner of the picture.
    focal = 0.5 * height / np.tan(0.35)
    corner = np.array([0.5 * width / focal, 0.5 * height / focal, 1.0])
    np.testing.assert_allclose(camera.K @ corner, [camera.width, camera.height, 1.0], rtol=1e-9)


@pytest.mark.parametrize(
    "changes",
    [
        {"fov": float("nan")},
        {"fov": 0.0},
        {"wxyz": np.zeros(4)},
        {"position": np.array([0.0, np.inf, 0.0])},
        {"width": 0},
        {"width": 100_000},
    ],
    ids=str,
)
def test_a_camera_that_makes_no_sense_is_not_drawn(changes: dict) -> None:
    given = {"wxyz": np.array([1.0, 0, 0, 0]), "position": np.zeros(3), "fov": 0.7}
    assert PageCamera(**{**given, "width": 640, "height": 480}).sound()
    assert not PageCamera(**{**given, "width": 640, "height": 480, **changes}).sound()


def test_one_angle_changes_and_nothing_else(tiny_avatar: WildGHandAvatar) -> None:
    view, angles = PosedView(tiny_avatar), tiny_avatar.studio.angles["right"]
    view.set_fingers("point")
    hand = view.hands["right"]
    before = angles.angles(hand.pose)
    view.set_angle("right", 4, 0, 12.5)
    found = angles.angles(view.hands["right"].pose)
    assert found[4, 0] == pytest.approx(12.5)
    before[4, 0] = 12.5
    np.testing.assert_allclose(found, before, atol=1e-6)
    np.testing.assert_array_equal(view.hands["right"].transl, hand.transl)
    view.set_angle("right", 4, 0, 1e9)
    assert shown_angles(view.hands["right"], angles)[4, 0] == angles.upper[4, 0]


def test_a_named_pose_keeps_the_hand_where_it_is(tiny_avatar: WildGHandAvatar) -> None:
    view, angles = PosedView(tiny_avatar), tiny_avatar.studio.angles["right"]
    view.set_angle("right", 0, 2, 40.0)
    hand = view.hands["right"]
    view.set_fingers("fist")
    found = view.hands["right"]
    np.testing.assert_array_equal(found.pose[0], hand.pose[0])
    np.testing.assert_allclose(found.pose[1:], angles.pose(angles.named_pose("fist"))[1:])
    np.testing.assert_array_equal(found.transl, hand.transl)


def test_the_full_picture_is_the_avatars_and_a_draft_is_near(tiny_avatar: WildGHandAvatar) -> None:
    view, camera = PosedView(tiny_avatar, None, (200, 0, 90)), tiny_avatar.studio.camera(96, 64)
    view.set_fingers("fist")
    expected = over(tiny_avatar.render("fist", camera), (200, 0, 90))
    np.testing.assert_array_equal(view.draw(camera, False).image, expected)
    draft = view.draw(camera, True)
    assert draft.draft
    assert draft.edge == 96
    assert psnr(draft.image, expected) > 30.0
    view.set_fingers("open")
    assert psnr(view.draw(camera, True).image, expected) < 25.0


def test_changes_of_the_view_reach_its_picture(tiny_avatar: WildGHandAvatar) -> None:
    view, changes = PosedView(tiny_avatar), []
    view.changed = lambda: changes.append(1)
    camera = tiny_avatar.studio.camera(64, 64)
    rest = view.draw(camera, False).image
    view.set_fingers("fist")
    view.set_background((0, 0, 0))
    fist = over(tiny_avatar.render("fist", camera), (0, 0, 0))
    np.testing.assert_array_equal(view.draw(camera, False).image, fist)
    view.rest()
    view.set_background((255, 255, 255))
    np.testing.assert_array_equal(view.draw(camera, False).image, rest)
    assert len(changes) == 4
    found = look_from(camera, tiny_avatar.studio.centre, 64)
    np.testing.assert_allclose(found.K, camera.K, atol=1e-6)


@given(per_pixel=st.floats(1e-9, 1e-4), other=st.floats(0.0, 0.5), first=st.integers(LEAST, MOST))
def test_the_pace_settles_where_a_picture_takes_the_time_that_it_may(
    per_pixel: float, other: float, first: int
) -> None:
    pace = Pace(first)
    for _ in range(60):
        pace.took(pace.edge, per_pixel * pace.edge**2, other)
        assert LEAST <= pace.edge <= MOST
    allowed = max(TARGET - other, TARGET / 3)
    assert pace.edge == LEAST or per_pixel * (pace.edge - 2) ** 2 <= allowed
    assert pace.edge == MOST or per_pixel * (pace.edge + 2) ** 2 >= allowed


@pytest.mark.parametrize(
    ("headers", "loopback", "answered"),
    [
        ({"Host": "127.0.0.1:8080"}, True, True),
        ({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, True, True),
        ({"Host": "[::1]:8080", "Origin": "http://[::1]:8080"}, True, True),
        ({"Host": "127.0.0.1:8080", "Origin": "https://elsewhere.org"}, True, False),
        ({"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:9999"}, True, False),
        ({"Host": "127.0.0.1:8080", "Origin": "null"}, True, False),
        ({"Host": "rebound.org:8080", "Origin": "http://rebound.org:8080"}, True, False),
        ({"Host": "lab.example:8080", "Origin": "http://lab.example:8080"}, False, True),
        ({"Host": "lab.example:8080", "Origin": "http://elsewhere.org"}, False, False),
        ({}, True, False),
    ],
    ids=str,
)
def test_only_pages_of_the_view_itself_may_connect(
    headers: dict[str, str], loopback: bool, answered: bool
) -> None:
    assert (refusal(headers, loopback) is None) == answered


@pytest.mark.parametrize("aspect", [0.4, 1.0, 2.5])
def test_the_sheet_of_a_fit_has_the_pages_shape_and_shows_all_four(aspect: float) -> None:
    colours = [(250, 0, 0), (0, 250, 0), (0, 0, 250)]
    truth, avatar, turned = (np.full((48, 64, 3), colour, np.uint8) for colour in colours)
    weights = np.full((48, 64), 3, dtype=np.uint8)
    page = live_sheet(Glance(3, 0.5, 12, 20.0, truth, avatar, weights, turned), aspect)
    assert page.shape[1] / page.shape[0] == pytest.approx(aspect, rel=0.01)
    areas = [int((page == colour).all(axis=-1).sum()) for colour in [*colours, (3, 3, 3)]]
    assert len(set(areas)) == 1
    assert areas[0] > 48 * 64


def test_a_motion_plays_round_and_stops() -> None:
    shown: list[int] = []
    enough = threading.Event()

    def show(frame: int) -> None:
        shown.append(frame)
        if len(set(shown)) == 4 and len(shown) > 8:
            enough.set()

    player = Player(np.array([0.0, 0.005, 0.015, 0.02]), show)
    player.play(2)
    player.play(0)  # it plays already
    assert enough.wait(60.0)
    player.stop()
    count = len(shown)
    player.stop()
    assert set(shown) == set(range(4))
    assert len(shown) == count


def test_the_capture_that_lies_with_an_avatar_is_found(
    make_capture: Callable[..., Capture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert capture_of(tmp_path / "avatar") is None
    within = make_capture("capture", frames=10, folder=tmp_path / "avatar" / "work")
    assert capture_of(tmp_path / "avatar") == within.root
    # In the avatar's folder itself it is named `.`, of which a path has no name.
    monkeypatch.chdir(tmp_path / "avatar")
    assert capture_of(Path(".")) == Path("work/capture")
    monkeypatch.chdir(tmp_path)
    assert capture_of(Path(".")) is None


def test_the_motion_of_a_capture_is_that_of_the_hands_that_the_avatar_has(
    tiny_avatar: WildGHandAvatar, make_painted: Callable[..., Capture]
) -> None:
    capture = make_painted("both")
    motion = Motion(tiny_avatar, capture)
    assert len(motion) == capture.info.frame_count
    view = PosedView(tiny_avatar, motion)
    view.set_frame(7)
    assert set(view.hands) == {"right"}
    expected = tiny_avatar.render({"right": capture.hand_poses(7)["right"]}, capture.camera(7))
    drawn = view.draw(motion.camera(7), False).image
    np.testing.assert_array_equal(drawn, over(expected, (255, 255, 255)))
    found = look_from(motion.camera(7), np.array([0.0, 0.0, 0.4]), 64)
    np.testing.assert_allclose(found.K, capture.camera(7).K, atol=1e-6)
    place = view.frame_viewpoint(7)
    np.testing.assert_allclose(place.position, np.zeros(3), atol=1e-9)
    with pytest.raises(UsageError, match="shows the left hand"):
        Motion(tiny_avatar, make_painted("left"))


class _Element:
    """An element of a page: like viser's, it calls back when the program sets it, too."""

    def __init__(self, value: Any = None) -> None:
        self._value, self._called = value, lambda event: None

    @property
    def value(self) -> Any:
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        self._value = value
        self._called(SimpleNamespace(client=None, target=self))

    def on_update(self, call: Callable[[Any], None]) -> Callable[[Any], None]:
        self._called = call
        return call

    on_click = on_update

    def moved_to(self, value: Any) -> None:
        """What a person does."""
        self._value = value
        self._called(SimpleNamespace(client=object(), target=self))


class _Gui:
    """The elements of a panel by folder and name."""

    def __init__(self) -> None:
        self.made: dict[str, _Element] = {}
        self._folder = ""

    @contextmanager
    def add_folder(self, name: str, **_: Any) -> Iterator[None]:
        self._folder = f"{name}/"
        yield
        self._folder = ""

    def __getattr__(self, name: str) -> Callable[..., _Element]:
        def add(label: str, *given: Any, initial_value: Any = None, **_: Any) -> _Element:
            value = initial_value if initial_value is not None else next(iter(given), None)
            return self.made.setdefault(self._folder + label, _Element(value))

        return add


def test_an_angle_that_is_changed_while_a_motion_plays_is_kept(
    tiny_avatar: WildGHandAvatar, make_painted: Callable[..., Capture]
) -> None:
    gui, view = _Gui(), PosedView(tiny_avatar, Motion(tiny_avatar, make_painted()))
    panel = Panel(gui, view, lambda place: None, (0, 0, 0))  # type: ignore[arg-type]
    angles = view.angles["right"]
    for playing in (True, False):
        gui.made["motion/play"].value = playing
        gui.made["index/index1 flexion"].moved_to(60.0 + playing)
        assert not gui.made["motion/play"].value
        assert gui.made["index/index1 flexion"].value == 60.0 + playing
        assert angles.angles(view.hands["right"].pose)[1, 0] == pytest.approx(60.0 + playing)
    panel.stop()


def test_a_hand_that_the_capture_does_not_show_has_its_sliders_too(
    make_painted: Callable[..., Capture],
) -> None:
    avatar = wildghand.fit(make_painted("both").root, settings={**TINY, "gaussians": 200}, steps=1)
    gui, view = _Gui(), PosedView(avatar, Motion(avatar, make_painted("left")))
    Panel(gui, view, lambda place: None, (0, 0, 0))  # type: ignore[arg-type]
    assert set(view.hands) == {"left"}
    slider, angles = gui.made["right index/index1 flexion"], view.angles["right"]
    slider.moved_to(50.0)
    assert set(view.hands) == {"left"}
    gui.made["pose/upright at rest"].moved_to(None)
    slider.moved_to(50.0)
    assert angles.angles(view.hands["right"].pose)[1, 0] == pytest.approx(50.0)


def test_pages_take_turns_while_something_moves() -> None:
    """Oracle: each gets every second picture, when both always wait for one."""
    arrive: list[Callable[[Any], None]] = []
    server = SimpleNamespace(
        on_client_connect=arrive.append, on_client_disconnect=lambda call: None
    )
    drawn: list[int] = []
    enough = threading.Event()

    def client(number: int) -> Any:
        def shown(image: np.ndarray, **_: Any) -> None:
            drawn.append(number)
            screen.touch()
            if len(drawn) >= 20:
                enough.set()

        camera = SimpleNamespace(
            wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
            position=np.zeros(3),
            fov=1.0,
            image_width=64,
            image_height=64,
            on_update=lambda call: call,
        )
        scene = SimpleNamespace(set_background_image=shown)
        return SimpleNamespace(client_id=number, camera=camera, scene=scene)

    picture = Picture(np.zeros((64, 64, 3), np.uint8), True, TARGET, 0.0)
    screen = Screen(server, lambda camera, draft: picture, 64)  # type: ignore[arg-type]
    for number in (1, 2):
        arrive[0](client(number))
    assert enough.wait(60.0)
    screen.stop()
    assert drawn.count(2) >= 8
