"""Frames that the authors' code has drawn. Oracles: the pixels that were written in its layout, and
the scores of the same pixels submitted as any other predictions."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from official_release import write_rendered
from small_captures import CaptureMaker
from small_methods import write_submission

from hwp_bench.base.images import read_rgb, read_rgba
from hwp_bench.capture import Capture
from hwp_bench.cli.main import main
from hwp_bench.leaderboard.rules import is_shipped
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.results import read_results

TEST = [18, 19]


@pytest.fixture
def capture(make_capture: CaptureMaker) -> Capture:
    return make_capture("capture0", frames=20, size=48)


def take(folder: Path, capture: Capture, out: Path, *more: str) -> int:
    words = ["data", "import", "rendered", str(folder), "--capture", str(capture.root)]
    return main([*words, "-o", str(out), *more])


def drawn(capture: Capture, frame: int) -> np.ndarray:
    """What `write_rendered` draws."""
    inside = capture.mask(frame)[..., None] > 127
    return np.where(inside, capture.frame(frame) // 2, 0).astype(np.uint8)


def test_drawings_are_scored_as_the_same_pixels_submitted(
    capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rendered(tmp_path / "c0_single", capture, TEST)
    out = tmp_path / "authors"
    assert take(tmp_path / "c0_single", capture, out) == 0
    told = capsys.readouterr()
    assert "2 of 2 test frames of capture0" in told.out
    # The ground truth next to the drawings is the capture's own frame: the cap of PSNR.
    assert "their ground truth: 100.0 dB" in told.out
    assert "warning" not in told.err
    for frame in TEST:
        taken = read_rgb(out / "predictions" / "capture0" / f"{frame:06d}.png")
        np.testing.assert_array_equal(taken, drawn(capture, frame))
    pixels = {f"capture0/{frame:06d}.png": drawn(capture, frame) for frame in TEST}
    other = write_submission(tmp_path / "other", pixels)
    for entry, name in ((out, "a"), (other, "b")):
        words = ["evaluate", str(entry), "--capture", str(capture.root)]
        assert main([*words, "-o", str(tmp_path / name)]) == 0
    first, second = read_results(tmp_path / "a"), read_results(tmp_path / "b")
    assert first.captures[0].frames == second.captures[0].frames
    assert first.captures[0].predictions_digest == second.captures[0].predictions_digest
    assert "hwp-v1" in first.protocols
    assert (tmp_path / "a" / "tables" / "overall.md").is_file()
    assert not is_shipped(first.method.name)


def test_captures_are_added_to_one_submission(
    make_capture: CaptureMaker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "authors"
    for name in ("capture0", "capture4"):
        one = make_capture(name, frames=20, size=48)
        write_rendered(tmp_path / name, one, TEST)
        assert take(tmp_path / name, one, out) == 0
    assert sorted(path.name for path in (out / "predictions").iterdir()) == ["capture0", "capture4"]
    assert read_manifest(out).name == "authors-code"
    before = (out / "method.toml").read_bytes()
    assert take(tmp_path / name, one, out) != 0
    assert "exists" in capsys.readouterr().err
    assert take(tmp_path / name, one, out, "--overwrite") == 0
    assert take(tmp_path / name, one, out, "--overwrite", "--name", "other") == 2
    assert "is the method 'authors-code'" in capsys.readouterr().err
    assert (out / "method.toml").read_bytes() == before
    assert take(tmp_path / name, one, tmp_path, "--name", "x") == 2
    assert "is not empty" in capsys.readouterr().err


def test_what_is_odd_is_named_or_handled(
    capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = write_rendered(tmp_path / "run", capture, TEST)
    for file in place.glob("frame19_*"):
        file.unlink()
    # A white background; half of the hand is half transparent.
    alpha = np.full((48, 48), 255, np.uint8)
    alpha[:, :24] = 128
    white = np.where(capture.mask(18)[..., None] > 127, drawn(capture, 18), 255).astype(np.uint8)
    file = place / "frame18_view18_pred_31.25_lr1.png"
    cv2.imwrite(str(file), np.dstack([white[:, :, ::-1], alpha]))
    cv2.imwrite(str(place / "frame18_view18_gt.png"), np.zeros((48, 48, 3), np.uint8))
    assert take(place, capture, tmp_path / "out", "--json") == 0
    told = capsys.readouterr()
    facts = json.loads(told.out)
    assert (facts["taken"], facts["missing"]) == ([18], [19])
    assert (facts["with_alpha"], facts["other_background"]) == ([18], [18])
    for words in ("without a drawing get the penalty: 19", "laid over black", "not black", "crop"):
        assert words in told.err
    taken = read_rgb(tmp_path / "out" / "predictions" / "capture0" / "000018.png")
    expected = np.rint(white * (alpha[..., None] / 255.0))
    np.testing.assert_array_equal(taken, expected)
    rgba = read_rgba(file)
    np.testing.assert_array_equal(rgba, np.dstack([white, alpha]))


def test_the_drawing_in_the_box_is_taken_where_no_other_is(
    capture: Capture, tmp_path: Path
) -> None:
    place = write_rendered(tmp_path / "run", capture, TEST)
    (place / "frame18_view18_pred_31.25_lr1.png").unlink()
    for file in place.glob("*_gt.png"):
        file.unlink()
    assert take(tmp_path / "run", capture, tmp_path / "out") == 0
    taken = tmp_path / "out" / "predictions" / "capture0"
    assert read_rgb(taken / "000018.png").max() == 0
    assert read_rgb(taken / "000019.png").max() > 0


def deep(place: Path) -> None:
    for file in place.glob("*_lr1.png"):
        cv2.imwrite(str(file), np.zeros((48, 48, 3), np.uint16))


def twice(place: Path) -> None:
    (place / "frame18_view18_pred_30.0_lr1.png").write_bytes(b"")


def other_run(place: Path) -> None:
    (place.parent / "more").mkdir()
    (place.parent / "more" / "frame18_view18_pred_30.0_lr1.png").write_bytes(b"")


def links(place: Path) -> None:
    for file in place.glob("*_pred_*"):
        target = file.rename(place.parents[3] / file.name)
        file.symlink_to(target)


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (deep, "holds uint16 samples where 8-bit is expected"),
        (twice, "frame 18 is drawn twice"),
        (other_run, "holds several runs"),
        (links, "holds no frameF_viewF_pred_PSNR_lrN.png"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_cannot_be_taken_is_one_line(
    damage, problem: str, capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(write_rendered(tmp_path / "run", capture, TEST))
    assert take(tmp_path / "run", capture, tmp_path / "out") != 0
    said = capsys.readouterr().err
    assert problem in said
    assert "Traceback" not in said
    assert not (tmp_path / "out" / "method.toml").exists()
    assert not (tmp_path / "out" / "predictions" / "capture0").exists()


def test_drawings_of_another_size_are_refused(
    capture: Capture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rendered(tmp_path / "run", capture, TEST, size=64)
    assert take(tmp_path / "run", capture, tmp_path / "out") != 0
    said = capsys.readouterr().err
    assert "is 64x64 pixels where 48x48 is expected" in said
    assert "Wanted are frames 18 to 19" in said
    # The same command takes the right ones.
    write_rendered(tmp_path / "right", capture, TEST)
    assert take(tmp_path / "right", capture, tmp_path / "out") == 0
    assert take(tmp_path / "nothing", capture, tmp_path / "out") != 0
    assert "is not a folder" in capsys.readouterr().err
