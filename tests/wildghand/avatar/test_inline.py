"""An avatar in a notebook. Oracles: the decoded pictures, a module that stands for the page's."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hwp_bench.base.errors import UsageError
from wildghand.avatar.avatar import TURN_FRAMES, WildGHandAvatar, over
from wildghand.page import show_page


def test_a_pose_is_a_picture_that_is_stored_whole(tiny_avatar: WildGHandAvatar) -> None:
    shown = tiny_avatar.show("fist", size=40, background=(10, 200, 30))
    bundle = shown._repr_mimebundle_()
    picture = Image.open(io.BytesIO(base64.b64decode(bundle["image/png"])))
    expected = over(tiny_avatar.render("fist", size=40), (10, 200, 30))
    np.testing.assert_array_equal(np.asarray(picture), expected)
    assert tuple(expected[0, 0]) == (10, 200, 30)
    assert "WildGHandAvatar(right hand" in bundle["text/plain"]
    assert 'width="40"' in shown._repr_html_()


def test_without_a_pose_the_avatar_turns(tiny_avatar: WildGHandAvatar) -> None:
    html = tiny_avatar.show(size=32)._repr_mimebundle_()["text/html"]
    (data,) = re.findall(r'src="data:image/webp;base64,([^"]+)"', html)
    turn = Image.open(io.BytesIO(base64.b64decode(data)))
    assert (turn.n_frames, turn.size) == (TURN_FRAMES, (32, 32))
    frames = []
    for frame in (0, TURN_FRAMES // 2):
        turn.seek(frame)
        frames.append(np.asarray(turn.convert("RGB")).astype(float))
    expected = over(tiny_avatar.render(size=32), (255, 255, 255))
    # WebP at this quality keeps a small picture to some levels.
    assert np.abs(frames[0] - expected).mean() < 6.0 < np.abs(frames[1] - frames[0]).mean()


def test_a_page_is_shown_where_a_notebook_takes_one(
    tiny_avatar: WildGHandAvatar, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(avatar: object, path: Path) -> None:
        assert avatar is tiny_avatar
        path.write_text("<p>turn \u21bb me</p>", encoding="utf-8")

    monkeypatch.setattr("wildghand.page.write.write_page", write)
    bundle = show_page(tiny_avatar, size=32)._repr_mimebundle_()
    (data,) = re.findall(r'<iframe src="data:text/html;base64,([^"]+)"', bundle["text/html"])
    assert base64.b64decode(data).decode() == "<p>turn \u21bb me</p>"
    assert "image/png" not in bundle


@pytest.mark.parametrize("size", [15, 5000])
def test_sizes_out_of_range_are_refused(size: int, tiny_avatar: WildGHandAvatar) -> None:
    with pytest.raises(UsageError, match=rf"size: is {size}"):
        tiny_avatar.show(size=size)
