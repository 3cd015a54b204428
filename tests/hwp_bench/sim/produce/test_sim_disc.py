"""A disc that fills at any moment of a render: one clear error, no half capture.

Oracle: the contract itself. The disc is simulated by the one call through which every file of
a capture takes its name, `os.replace`, which reports that no space is left after some files.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.capture import open_capture
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.scene.scene import Scene

DISC_FRAMES, SIZE = 10, 32


# Frames wait as one file each; then come images, tracks and the metadata of the capture.
@pytest.mark.parametrize("files", [3, DISC_FRAMES + 4, DISC_FRAMES + 5 * DISC_FRAMES + 2])
def test_a_disc_that_fills(
    files: int, make_scene: Callable[..., Scene], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, out = make_scene(), tmp_path / "full"
    honest, written = os.replace, []

    def replace(source: str, target: str) -> None:
        # What lies outside, the cache of skins for instance, has its own disc.
        if tmp_path in Path(target).parents:
            if len(written) >= files:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            written.append(target)
        honest(source, target)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(HwpError, match="No space left") as caught:
        render_capture(scene, out, frame_count=DISC_FRAMES, size=SIZE, workers=1, free_view=False)
    assert str(caught.value).count("\n") == 0
    assert not out.exists()
    assert not list(tmp_path.glob("*.lock")) + list(tmp_path.glob(".*.lock"))
    with pytest.raises(BadInput):
        open_capture(out)
    monkeypatch.setattr(os, "replace", honest)
    # With space again the same call goes on from the frames that were finished.
    assert (
        len(render_capture(scene, out, frame_count=DISC_FRAMES, size=SIZE, workers=1, free_view=False))
        == DISC_FRAMES
    )
    assert [path.name for path in tmp_path.iterdir()] == ["full"]
