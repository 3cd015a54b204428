"""Where a clip is drawn to. Oracle: the option's name in the message, and the files on disk."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_captures import CaptureMaker

from hwp_bench.base.errors import UsageError
from wildghand.avatar.render import render_clip


def test_an_existing_folder_is_refused_with_the_option_that_replaces_it(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture(frames=3)
    avatar: Any = SimpleNamespace(
        sides=("right",),
        hand_model=capture.info.hand_model,
        render=lambda hands, camera: np.zeros((camera.height, camera.width, 4)),
    )
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
