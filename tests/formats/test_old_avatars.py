"""Avatars of earlier versions can always be opened. Oracle: the image that those versions drew.

`avatar_version_1` was made from a simulated capture by the last version that wrote
`wildghand-avatar/1` (300 Gaussians, 20 steps, no DPD), and `avatar_version_1.png` was drawn by it.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hwp_bench.base.errors import BadInput
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar, save_avatar

FORMATS = Path(__file__).parent
OLD = FORMATS / "avatar_version_1"
SIZE = 64


def drawn(avatar: WildGHandAvatar) -> np.ndarray:
    """The hand of the stored image, (64, 64, 4) in levels of 8 bits."""
    pose = 0.1 * np.sin(np.arange(48.0)).reshape(16, 3)
    pose[0] += [np.pi / 2, 0.0, 0.0]
    hand = HandPose("right", pose, avatar.betas["right"], np.array([0.09, 0.0, 0.45]))
    K = np.array([[1.4 * SIZE, 0, SIZE / 2], [0, 1.4 * SIZE, SIZE / 2], [0, 0, 1.0]])
    return 255.0 * avatar.render({"right": hand}, Camera(K, np.eye(4), SIZE, SIZE))


def stored() -> np.ndarray:
    bgra = cv2.imread(str(FORMATS / "avatar_version_1.png"), cv2.IMREAD_UNCHANGED)
    return bgra[..., [2, 1, 0, 3]].astype(float)


def test_an_old_avatar_draws_what_it_drew() -> None:
    avatar = load_avatar(OLD)
    # Half a level of rounding in the stored image, and half a level for another machine's sums.
    assert np.abs(drawn(avatar) - stored()).max() <= 1.0
    assert stored().max() > 100.0


def test_its_settings_have_todays_names() -> None:
    settings = load_avatar(OLD).settings
    assert settings.prior == ""
    assert settings.gaussians == 300
    assert not settings.dpd.enabled
    assert not settings.dpd.gains
    assert settings.dpd.omega_scale == 0.1
    assert (settings.pao.enabled, settings.pao.variant, settings.pao.beta) == (True, "scaled", 500)
    assert settings.heads.refinement
    assert settings.prepass.frame_poses
    assert (settings.prepass.enabled, settings.prepass.weight_floor) == (True, 0.05)
    assert settings.schedule.steps == 2000
    assert settings.schedule.rates.pose == 0.0002
    assert (settings.terms.bias, settings.terms.dssim_weight) == (0.002, 0.2)
    assert settings.network.identity_resolution == 24


def test_what_was_remembered_of_the_fit_is_there() -> None:
    record = load_avatar(OLD).record
    assert (record.steps, len(record.frames), len(record.clean)) == (20, 28, 28)
    assert record.source == {"capture": "capture0"}


def test_it_is_written_again_as_todays_version(tmp_path: Path) -> None:
    avatar = load_avatar(OLD)
    save_avatar(avatar, tmp_path / "avatar")
    written = json.loads((tmp_path / "avatar" / "avatar.json").read_text())
    assert written["schema"] == "wildghand-avatar/2"
    # Everybody may read it whom the umask allows: its mode is that of a file made by hand.
    (tmp_path / "plain").touch()
    usual = (tmp_path / "plain").stat().st_mode
    files = [path for path in (tmp_path / "avatar").rglob("*") if path.is_file()]
    assert {path.stat().st_mode for path in files} == {usual}
    assert "loss" not in written["fit"]
    again = load_avatar(tmp_path / "avatar")
    assert again.settings == avatar.settings
    assert again.record == avatar.record
    np.testing.assert_array_equal(drawn(again), drawn(avatar))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": "wildghand-avatar/9"}, "wildghand-avatar/9"),
        ({"settings": {"mode": "other"}}, "mode: is 'other'"),
        ({"settings": {"unheard": 1}}, "unheard: is not a setting"),
        ({"fit": {"loss": 0.0, "unheard": 1}}, "unheard"),
    ],
    ids=str,
)
def test_bad_old_avatars_are_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(OLD, tmp_path / "avatar"))
    value = json.loads((folder / "avatar.json").read_text())
    (folder / "avatar.json").write_text(json.dumps({**value, **changes}))
    with pytest.raises(BadInput, match=message) as caught:
        load_avatar(folder)
    assert "\n" not in str(caught.value)
