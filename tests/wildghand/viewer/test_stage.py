"""An avatar's Gaussians and cameras in 3D. Oracle: a pinhole camera by hand, which says where
coloured Gaussians and the centres of cameras lie in the picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_fits import TINY

import wildghand
from hwp_bench.base.errors import BadInput
from hwp_bench.base.images import read_rgb
from hwp_bench.base.scene3d import ANGLE, EDGE, SideView
from hwp_bench.capture import Cameras
from wildghand.avatar.avatar import PosedGaussians
from wildghand.avatar.files import save_avatar
from wildghand.cli.main import main
from wildghand.viewer.stage import draw_gaussians

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
CAMERA = (204, 51, 17)


def pixel(view: SideView, point: np.ndarray) -> np.ndarray:
    """Column and row of a world point."""
    ahead = (view.focus - view.eye) / np.linalg.norm(view.focus - view.eye)
    right = np.cross(ahead, view.up)
    right /= np.linalg.norm(right)
    x, y, z = np.stack([right, np.cross(ahead, right), ahead]) @ (point - view.eye)
    return 0.5 * EDGE + 0.5 * EDGE / np.tan(np.radians(0.5 * ANGLE)) * np.array([x, y]) / z


def color_at(image: np.ndarray, place: np.ndarray, reach: int = 2) -> set[tuple[int, ...]]:
    column, row = np.rint(place).astype(int)
    part = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
    return {tuple(color) for color in part.reshape(-1, 3).tolist()}


def cameras(count: int = 5) -> Cameras:
    """They move to the right and look along z."""
    views = np.tile(np.eye(4), (count, 1, 1))
    views[:, 0, 3] = -np.linspace(0.0, 0.2, count)
    K = np.array([[90.0, 0, 32.0], [0, 90.0, 32.0], [0, 0, 1.0]])
    return Cameras(np.tile(K, (count, 1, 1)), views)


def three() -> PosedGaussians:
    """One red, one green, one blue ball; a black one that is nearly transparent."""
    means = [[0.0, 0.0, 0.6], [0.1, 0.0, 0.6], [0.0, -0.1, 0.6], [0.0, 0.05, 0.5]]
    return PosedGaussians(
        np.array(means, np.float32),
        np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (4, 1)),
        np.full((4, 3), 0.02, np.float32),
        np.array([0.9, 0.8, 1.0, 0.01], np.float32),
        np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1.4], [0, 0, 0]], np.float32),
    )


def test_gaussians_and_cameras_lie_where_they_are(tmp_path: Path) -> None:
    view = draw_gaussians(three(), cameras(), 2, (64, 64), tmp_path / "stage.png")
    image = read_rgb(tmp_path / "stage.png", (EDGE, EDGE))
    for mean, color in zip(three().means, (RED, GREEN, BLUE), strict=False):
        assert color_at(image, pixel(view, mean.astype(float))) == {color}
    assert (0, 0, 0) not in color_at(image, pixel(view, three().means[3].astype(float)))
    # The path of the cameras is red; the pyramid of the frame is, too, and those of others are not.
    for x in (0.02, 0.1, 0.18):
        assert CAMERA in color_at(image, pixel(view, np.array([x, 0.0, 0.0])))
    depth = 0.25 * np.linalg.norm(three().means.mean(axis=0) - [0.1, 0.0, 0.0])
    for row, x in ((2, 0.1), (0, 0.0), (4, 0.2)):
        corner = np.array([x, 0.0, 0.0]) + 0.7 * depth * np.array([32.0 / 90, 32.0 / 90, 1.0])
        found = color_at(image, pixel(view, corner))
        assert (CAMERA if row == 2 else (136, 136, 136)) in found
    # Up in the picture is up for the camera: the blue ball is above the red one.
    assert pixel(view, three().means[2])[1] < pixel(view, three().means[0])[1]
    assert color_at(image, np.array([5.0, 5.0])) == {(255, 255, 255)}


def test_the_command_draws_an_avatar(
    make_painted, tmp_path: Path, capfd, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    capture = make_painted()
    avatar = wildghand.fit(capture.root, settings=TINY, steps=1, all_frames=True)
    save_avatar(avatar, tmp_path / "avatar")
    out = tmp_path / "stage.png"
    words = ["stage", str(tmp_path / "avatar"), "--poses", str(capture.root), "-o", str(out)]
    capfd.readouterr()
    assert main([*words, "--frame", "3"]) == 0
    told = capfd.readouterr()
    count = len(avatar.pose(capture.hand_poses(3), closed=True))
    assert told.out == f"{out}: {count} Gaussians\n"
    assert told.err == ""
    drawn = (read_rgb(out, (EDGE, EDGE)) < 250).any(axis=2).mean()
    assert 0.005 < drawn < 0.5
    for more, text in (
        ([], "--overwrite"),
        (["--overwrite", "--frame", "999"], "there is no frame 999"),
        (["-o", str(tmp_path / "a.gif")], "ending"),
    ):
        assert main([*words, *more]) == 2
        assert text in capfd.readouterr().err
    assert main(["stage", str(tmp_path / "avatar"), "-o", str(tmp_path / "b.png")]) == 2
    assert "--poses" in capfd.readouterr().err


def test_gaussians_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    posed = three()
    posed.means[1, 2] = torch.nan
    with pytest.raises(BadInput, match="NaN"):
        draw_gaussians(posed, cameras(), 0, (64, 64), tmp_path / "stage.png")
    assert not (tmp_path / "stage.png").exists()
