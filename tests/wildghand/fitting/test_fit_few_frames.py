"""`wildghand fit` on clips of one and of a few frames. Oracles: the message; finite renderings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker

from hwp_bench.capture import Capture, CaptureWriter
from hwp_bench.capture.schema import Cameras
from wildghand.avatar.files import load_avatar
from wildghand.cli.main import main
from wildghand.fitting.session import unfinished

SMALL = ("--steps", "2", "--set", "gaussians=200", "--set", "device=cpu")


@pytest.mark.parametrize("frames", [1, 2])
@pytest.mark.parametrize("words", [(), ("--all-frames",)])
def test_too_few_frames_for_a_split_are_one_message(
    frames: int,
    words: tuple[str, ...],
    make_capture: CaptureMaker,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    capture = make_capture(frames=frames, perturbations={})
    out = tmp_path / "avatar"
    assert main(["fit", str(capture.root), "-o", str(out), *SMALL, *words]) == (1 if words else 2)
    said = capsys.readouterr().err
    assert said.count("error:") == 1
    assert f"has {frames} of the 3 frames" if words else "needs at least 10 frames" in said
    assert "Traceback" not in said
    assert not out.exists()


def test_the_state_of_a_fit_lies_next_to_its_folder_however_that_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A path has no name where it ends with a point."""
    (tmp_path / "avatar" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "avatar")
    for text in (".", "", "below/..", "../avatar", str(tmp_path / "avatar")):
        assert unfinished(Path(text)) == tmp_path / "avatar.fit", text


@pytest.mark.slow
def test_one_training_frame_makes_an_avatar(
    make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    """Of three frames the last two stand for validation and test."""
    whole = make_painted()
    (hand,) = whole.hands.values()
    short = replace(hand, pose=hand.pose[:3], transl=hand.transl[:3], valid=hand.valid[:3])
    clip = Cameras(whole.cameras.Ks[:3], whole.cameras.viewmats[:3])
    info = replace(whole.info, frame_count=3, digests=None)
    with CaptureWriter(tmp_path / "short", info, {"right": short}, clip) as writer:
        for frame in range(3):
            writer.frame(frame, whole.frame(frame))
            writer.mask(frame, whole.mask(frame))
    out = tmp_path / "avatar"
    assert main(["fit", str(tmp_path / "short"), "-o", str(out), "--all-frames", *SMALL]) == 0
    picture = load_avatar(out).render("rest", size=48)
    assert np.isfinite(picture).all()
    assert picture[..., 3].max() > 0.1
