"""The stage in 3D, drawn without a display. Oracle: where a pinhole camera by hand sees the lamp,
the camera, the hand and the object, and their colours there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_scene import SINGLE

from hwp_bench.base.images import read_rgb
from hwp_bench.base.scene3d import ANGLE, EDGE, SideView, see_whole
from hwp_bench.cli.main import main
from hwp_bench.sim.light.lights import focus_point
from hwp_bench.sim.produce.preview import stage_side
from hwp_bench.sim.scene_files import parse_scene


def pixels(view: SideView, points: np.ndarray) -> np.ndarray:
    """(N, 2) columns and rows of world points in a square picture."""
    ahead = view.focus - view.eye
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, view.up)
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    seen = (np.atleast_2d(points) - view.eye) @ np.stack([right, down, ahead], axis=1)
    focal = 0.5 * EDGE / np.tan(np.radians(0.5 * ANGLE))
    return 0.5 * EDGE + focal * seen[:, :2] / seen[:, 2:]


def around(image: np.ndarray, place: np.ndarray, reach: int = 4) -> np.ndarray:
    """The colours near a pixel, (N, 3)."""
    column, row = np.rint(place).astype(int)
    part = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
    return part.reshape(-1, 3).astype(int)


def near(colors: np.ndarray, color: tuple[int, int, int], tolerance: int = 12) -> np.ndarray:
    return (np.abs(colors - color) <= tolerance).all(axis=1)


def test_a_scene_is_drawn_with_its_lamp_camera_hand_and_object(
    small_paintings: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    (tmp_path / "tiny.toml").write_text(SINGLE)
    words = ["sim", "preview", str(tmp_path / "tiny.toml"), "--stage", "-o", str(tmp_path)]
    assert main(words) == 0
    told = capfd.readouterr()
    assert str(tmp_path / "tiny-stage.png") in told.out
    # VTK's own warnings, of a missing display, are not shown.
    assert told.err == ""
    image = read_rgb(tmp_path / "tiny-stage.png", (EDGE, EDGE))
    view, focus = stage_side(), focus_point()
    direction = np.array(parse_scene(SINGLE, where="tiny.toml").light.direction, dtype=float)
    lamp = focus + 0.25 * direction / np.linalg.norm(direction)
    places = pixels(view, np.stack([lamp, focus, np.zeros(3)]))
    assert near(around(image, places[0]), (255, 204, 51)).all()
    # The hand is skin in the light or in the shade: red above blue, and not white.
    hand = around(image, places[1], 25)
    skin = (hand[:, 0] > hand[:, 2] + 20) & (hand.sum(axis=1) < 690)
    assert skin.mean() > 0.3
    # The handheld camera's path lies around the origin; its pyramid leaves it in grey.
    assert near(around(image, places[2], 12), (204, 51, 17), 40).any()
    corner = np.array([np.tan(np.radians(12.0))] * 2 + [1.0])
    edge = pixels(view, np.outer(np.linspace(0.3, 0.9, 7), 0.2 * corner))
    assert all((np.abs(around(image, place, 2) - 102).max(axis=1) < 90).any() for place in edge)
    # The block is blue; nothing else is.
    colors = image.reshape(-1, 3).astype(int)
    assert (colors[:, 2] > colors[:, 0] + 30).sum() > 200
    # Nothing is drawn in the corners.
    for row in (slice(0, 60), slice(-60, None)):
        assert (image[row, :60] == 255).all()


def test_everything_is_in_the_picture() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3)) * [1.0, 0.2, 3.0] + [4.0, 5.0, 6.0]
    for direction in ([0.0, 0.0, 1.0], [1.0, -2.0, 0.5]):
        view = see_whole(points, np.array(direction), np.array([0.0, -1.0, 0.0]))
        found = pixels(view, points)
        assert found.min() > 0.0
        assert found.max() < EDGE
        assert np.ptp(found, axis=0).max() > 0.4 * EDGE
