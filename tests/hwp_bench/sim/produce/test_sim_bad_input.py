"""Bad scenes, killed renders and full discs: one clear message, and no half capture.

Oracle: the contract itself, word for word where a person has to act on it. A disc that fills is
simulated by the one call through which every file of a capture takes its name, `os.replace`,
which reports that no space is left after some files.
"""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from tiny_scene import SINGLE

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.capture import open_capture
from hwp_bench.cli.main import main
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.scene.scene import Scene

FRAMES, SIZE = 24, 32

BAD_SCENES = {
    "unknown effect": (
        'kind = "illumination"',
        'kind = "earthquake"',
        "effects[1].kind: is 'earthquake'. Known: ",
        "motion_blur",
    ),
    "missing field": ('title = "A small scene"\n', "", "title: is missing", ""),
    "missing table": ("[camera]\nhandheld = true\nfield_of_view = 24.0\n", "", "camera", "missing"),
    "object that does not exist": (
        'object = "block"',
        'object = "brick"',
        "effects(hand_object_interaction).items[0].object: there is no object 'brick'. Known: ",
        "block",
    ),
    "severity out of range": (
        "[[0.3, 0.4, 3]]",
        "[[0.3, 0.4, 7]]",
        "effects[1].episodes: severity 7.0 is not in 1..5",
        "",
    ),
    "no TOML": ("[subject]", "[subject", "is not valid TOML", ""),
}


@pytest.mark.parametrize(
    ("case", "action"),
    [
        *((case, "render") for case in BAD_SCENES),
        *(("no TOML", action) for action in ("plan", "preview", "calibrate")),
    ],
)
def test_a_bad_scene_is_one_line(
    case: str, action: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new, *words = BAD_SCENES[case]
    assert old in SINGLE
    path = tmp_path / "mine.toml"
    path.write_text(SINGLE.replace(old, new))
    out = [] if action in ("plan", "calibrate") else ["-o", str(tmp_path / "out")]
    group = "dev" if action in ("plan", "calibrate") else "sim"
    assert main([group, action, str(path), *out]) == BadInput.exit_status
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    for word in (str(path), *words):
        assert word in shown.err
    assert list(tmp_path.iterdir()) == [path]


def _finished(folder: Path) -> int:
    return len(list(folder.glob(".capture.*/*.npz")))


def _wait_for(condition: Callable[[], bool]) -> None:
    # The suite's own time limit ends a wait that never comes true.
    while not condition():
        time.sleep(0.02)


@pytest.mark.slow
def test_a_killed_render_leaves_no_capture_and_goes_on(tmp_path: Path) -> None:
    path, out = tmp_path / "tiny.toml", tmp_path / "capture"
    path.write_text(SINGLE)
    extent = ["--frame-count", str(FRAMES), "--size", str(SIZE), "--workers", "2"]
    command = ["sim", "render", str(path), "-o", str(out), *extent, "--no-free-view"]
    with subprocess.Popen([sys.executable, "-m", "hwp_bench.cli.main", *command]) as process:
        _wait_for(lambda: _finished(tmp_path) >= 2 or process.poll() is not None)
        workers = psutil.Process(process.pid).children()
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not out.exists()
    with pytest.raises(BadInput):
        open_capture(out)
    # The processes that it had started end by themselves.
    psutil.wait_procs(workers)
    assert 2 <= _finished(tmp_path) < FRAMES
    assert main([*command, "--workers", "1"]) == 0
    peace = tmp_path / "peace"
    assert main(["sim", "render", str(path), "-o", str(peace), *command[5:], "--workers", "1"]) == 0
    assert len(open_capture(out)) == FRAMES
    assert open_capture(out).digest == open_capture(peace).digest
    assert {entry.name for entry in tmp_path.iterdir()} == {"tiny.toml", "capture", "peace"}


@pytest.mark.slow
def test_a_killed_worker_is_one_clear_error(
    make_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    out, scene = tmp_path / "capture", make_scene()
    before = set(psutil.Process().children())

    def kill_one() -> None:
        _wait_for(lambda: _finished(tmp_path) >= 2)
        worker = next(iter(set(psutil.Process().children()) - before))
        os.kill(worker.pid, signal.SIGKILL)

    killer = threading.Thread(target=kill_one, daemon=True)
    killer.start()
    with pytest.raises(HwpError, match=r"a rendering process was killed \(SIGKILL\)") as caught:
        render_capture(scene, out, frame_count=FRAMES, size=SIZE, workers=2)
    killer.join()
    assert "the same command continues" in str(caught.value)
    assert not out.exists()
    assert not set(psutil.Process().children()) - before  # the other worker was ended


DISC_FRAMES = 10


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
    whole = render_capture(
        scene, out, frame_count=DISC_FRAMES, size=SIZE, workers=1, free_view=False
    )
    assert len(whole) == DISC_FRAMES
    assert [path.name for path in tmp_path.iterdir()] == ["full"]
