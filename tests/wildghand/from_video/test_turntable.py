"""The turntable's views. Oracles: which way a hand points, from the posed mesh and the pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from painted import SilentReport

from hwp_bench.methods.contract import Budget, TrainingCapture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import write_weight_masks
from wildghand.fitting.method import WildGHandMethod
from wildghand.from_video.stages import BACKGROUND, COLUMNS, Turntable, avatar_sheet

SIZE = 96
ANGLES = (0, 45, 90, 135, 180, 225, 270, 315)


_MADE: dict[str, WildGHandAvatar] = {}


def made(hands: str, make_training: Callable[..., TrainingCapture]) -> WildGHandAvatar:
    """An avatar that is hardly fitted: it has the shape of the template, painted in red."""
    if hands not in _MADE:
        method = WildGHandMethod({"gaussians": 600, "device": "cpu", "schedule.steps": 1}, 0)
        _MADE[hands] = method.fit(make_training(hands), Budget(), SilentReport())
    return _MADE[hands]


@pytest.fixture(params=["right", "left", "both"])
def avatar(request, make_training: Callable[..., TrainingCapture]) -> WildGHandAvatar:
    return made(request.param, make_training)


def hand_pixels(view: np.ndarray) -> np.ndarray:
    """Where the hand covers half of a pixel or more: its red is some 200."""
    return np.abs(view.astype(int) - BACKGROUND).max(axis=2) > 80


def test_all_of_the_hand_is_seen_from_everywhere(avatar: WildGHandAvatar) -> None:
    table = Turntable(avatar, SIZE)
    tallest = 0
    for angle in ANGLES:
        seen = hand_pixels(table.view(angle))
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        assert rows[0] > 0
        assert columns[0] > 0
        assert rows[-1] < SIZE - 1
        assert columns[-1] < SIZE - 1
        tallest = max(tallest, len(rows), len(columns))
    assert tallest > 0.7 * SIZE


@pytest.mark.parametrize("side", ["right", "left"])
def test_fingers_point_up_and_the_palm_comes_first(
    make_training: Callable[..., TrainingCapture], side: str
) -> None:
    """The wrist is below, one piece wide; above are fingers. At 0 the right thumb is right."""
    avatar = made(side, make_training)
    table = Turntable(avatar, SIZE)
    front, back = hand_pixels(table.view(0)), hand_pixels(table.view(180))
    rows = np.flatnonzero(front.any(axis=1))
    quarter = (rows[-1] - rows[0]) // 4

    def pieces(row: int) -> int:
        return int(np.count_nonzero(np.diff(front[row].astype(int)) == 1))

    assert pieces(rows[0] + quarter) >= 2
    assert pieces(rows[-1] - quarter) == 1
    # Of the outermost fingers, thumb and little finger, the thumb is the lower one.
    is_right = avatar.sides == ("right",)
    for seen, thumb_right in ((front, is_right), (back, not is_right)):
        columns = np.flatnonzero(seen.any(axis=0))
        left, right = (np.flatnonzero(seen[:, columns[end]]).max() for end in (0, -1))
        assert bool(right > left) is thumb_right


def test_a_whole_turn_comes_back(avatar: WildGHandAvatar) -> None:
    table = Turntable(avatar, SIZE)
    np.testing.assert_allclose(table.view(0).astype(int), table.view(360), atol=1)
    assert np.abs(table.view(0).astype(int) - table.view(90)).max() > 25


def test_the_sheet_shows_frames_avatar_weights_and_sides(
    make_training: Callable[..., TrainingCapture], make_painted, tmp_path: Path
) -> None:
    avatar = made("right", make_training)
    write_weight_masks(avatar, tmp_path / "weights")
    picture = avatar_sheet(avatar, make_painted(), tmp_path / "weights")
    without = avatar_sheet(avatar, make_painted(), tmp_path / "absent")
    cell = (picture.shape[0] - 4) // 4
    # Four rows of six; without masks the third is left out.
    assert without.shape[0] == picture.shape[0] - cell
    assert picture.shape[1] // COLUMNS == pytest.approx(cell, abs=30)
    for row in range(4):
        assert picture[row * cell : (row + 1) * cell].std() > 5
    # The rows that both have are the same: the drawing takes nothing from the masks but frames.
    np.testing.assert_array_equal(picture[-cell:], without[-cell:])
