"""A clip that is drawn, and where to. Oracles: single frames, messages, the files on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_captures import CaptureMaker

from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.capture import Capture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.render import hands_of, render_clip


def _blank(capture: Capture) -> Any:
    """An avatar that draws nothing."""
    return SimpleNamespace(
        sides=("right",),
        hand_model=capture.info.hand_model,
        betas={"right": np.zeros(10)},
        believed=dict,
        render=lambda hands, camera: np.zeros((camera.height, camera.width, 4)),
    )


def test_an_existing_folder_is_refused_with_the_option_that_replaces_it(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture(frames=3)
    avatar = _blank(capture)
    out = tmp_path / "frames"
    render_clip(avatar, capture, range(2), out)
    with pytest.raises(UsageError, match="--overwrite"):
        render_clip(avatar, capture, range(1), out)
    render_clip(avatar, capture, range(1), out, overwrite=True)
    assert [path.name for path in out.iterdir()] == ["000000.png"]
    (out / "thesis.tex").touch()
    with pytest.raises(UsageError, match="something else than frames"):
        render_clip(avatar, capture, range(1), out, overwrite=True)
    assert (out / "thesis.tex").is_file()


def test_an_existing_video_is_not_replaced(make_capture: CaptureMaker, tmp_path: Path) -> None:
    capture = make_capture(frames=3)
    out, video = tmp_path / "frames", tmp_path / "hand.mp4"
    video.write_bytes(b"my recording")
    with pytest.raises(UsageError, match="--video: exists"):
        render_clip(_blank(capture), capture, range(2), out, video=video)
    assert video.read_bytes() == b"my recording"
    assert not out.exists()
    render_clip(_blank(capture), capture, range(2), out, video=video, overwrite=True)
    assert video.read_bytes() != b"my recording"


def test_every_frame_is_drawn_in_its_own_pose_over_the_background(
    tiny_avatar: WildGHandAvatar, make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    """Oracle: the avatar's own drawing of each frame, laid over the grey here; half a level."""
    capture = make_painted()
    render_clip(tiny_avatar, capture, range(2, 11, 8), tmp_path / "frames", background=100)
    images = sorted((tmp_path / "frames").iterdir())
    found = {int(path.stem): read_rgb(path).astype(float) for path in images}
    assert list(found) == [2, 10]
    for frame, image in found.items():
        rgba = tiny_avatar.render(capture.hand_poses(frame), capture.camera(frame)).astype(float)
        expected = 255.0 * rgba[..., :3] + 100.0 * (1.0 - rgba[..., 3:])
        np.testing.assert_allclose(image, expected, atol=0.51)
    assert not np.array_equal(found[2], found[10])


def test_the_motion_of_another_person_does_not_change_the_shape(
    tiny_avatar: WildGHandAvatar, make_painted: Callable[..., Capture]
) -> None:
    own = make_painted()
    hand = own.hands["right"]
    other = replace(own, hands={"right": replace(hand, betas=hand.betas + 1.0)})
    for frame in (0, 5):
        found = hands_of(tiny_avatar, other, frame)["right"]
        expected = tiny_avatar.believed(own.hand_poses(frame))["right"]
        for name in ("pose", "betas", "transl"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
