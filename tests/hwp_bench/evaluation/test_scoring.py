"""Colours of another range or order are said; honest predictions are not accused.

Oracle: predictions that are made wrong on purpose, with their mean computed by hand.

A copy of a capture without its truth is scored on other masks, and is other data.

Oracles: a whole capture and a copy of it, predictions that are the same pixels, and the words of
the commands.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_captures import CaptureMaker, hand_picture
from small_methods import write_submission

from hwp_bench.base.files import sha256_json
from hwp_bench.base.images import as_uint8
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.cli.main import main
from hwp_bench.evaluation.scoring import Prediction, Target, colour_warnings
from hwp_bench.evaluation.verify import verify_results
from hwp_bench.report.sources import find_captures
from hwp_bench.results import Results, read_results


def _targets() -> list[Target]:
    pictures = [hand_picture(frame, 48) for frame in range(4)]
    return [Target(i, picture, mask, False) for i, (picture, mask) in enumerate(pictures)]


def _said(change) -> list[str]:
    targets = _targets()
    drawn = [Prediction(t.frame, change(t.pixels), None) for t in targets]
    return colour_warnings(targets, drawn)


def test_colours_up_to_255_in_place_of_1_are_said_with_their_mean() -> None:
    (text,) = _said(lambda pixels: as_uint8(pixels.astype(np.float64)))
    assert "100 % of the predicted colours are 255" in text
    assert "mean is 255.0 of 255, the truth's" in text


def test_colours_up_to_1_in_place_of_255_are_said() -> None:
    (text,) = _said(lambda pixels: (pixels / 255.0).astype(np.uint8))
    assert "above 0 of 255" in text or "above 1 of 255" in text


def test_exchanged_channels_are_said_with_both_scores() -> None:
    (text,) = _said(lambda pixels: np.ascontiguousarray(pixels[:, :, ::-1]))
    assert "red and blue exchanged" in text


def test_frames_without_a_prediction_are_left_out() -> None:
    targets = _targets()
    assert colour_warnings(targets, [Prediction(t.frame, None, "missing") for t in targets]) == []


@given(
    st.tuples(*[st.floats(0.8, 1.2)] * 3),
    st.integers(0, 40),
    st.integers(0, 2**31),
)
def test_poor_predictions_are_not_accused(gains, noise: int, seed: int) -> None:
    random = np.random.default_rng(seed)

    def worse(pixels: np.ndarray) -> np.ndarray:
        changed = pixels * np.array(gains) + random.normal(0, noise + 1e-9, pixels.shape)
        return changed.clip(0, 255).astype(np.uint8)

    assert _said(worse) == []


@pytest.mark.parametrize("level", [0, 128, 240])
def test_an_even_picture_is_not_accused_of_an_order(level: int) -> None:
    assert all("exchanged" not in text for text in _said(lambda p: np.full_like(p, level)))


def test_evaluate_warns_and_leaves_the_score_alone(
    make_capture: CaptureMaker, tmp_path: Path, capsys
) -> None:
    capture = make_capture(frames=20, size=48)
    entry, out = tmp_path / "entry", tmp_path / "out"
    images = {
        f"tiny/{frame:06d}.png": np.ascontiguousarray(capture.frame(frame)[:, :, ::-1])
        for frame in (18, 19)
    }
    write_submission(entry, images, "bgr")
    words = ["evaluate", str(entry), "--capture", str(capture.root), "--out", str(out)]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "warning: tiny: with red and blue exchanged" in " ".join(captured.err.split())
    assert "100.00" not in captured.out


@pytest.fixture
def whole(make_capture: CaptureMaker) -> Capture:
    return make_capture("clip", frames=20, size=48, truth=True)


@pytest.fixture
def stripped(whole: Capture, tmp_path: Path) -> Capture:
    folder = shutil.copytree(whole.root, tmp_path / "copy")
    shutil.rmtree(folder / "truth")
    return open_capture(folder)


@pytest.fixture
def both(whole: Capture, stripped: Capture, tmp_path: Path) -> list[Results]:
    for name, capture in (("one", whole), ("two", stripped)):
        images = {f"clip/{frame:06d}.png": whole.frame(frame) // 2 for frame in (18, 19)}
        folder = write_submission(tmp_path / name, images, name)
        words = ["evaluate", str(folder), "-o", str(tmp_path / f"out-{name}")]
        assert main([*words, "--capture", str(capture.root)]) == 0
    return [read_results(tmp_path / f"out-{name}") for name in ("one", "two")]


def test_the_digest_says_which_masks_are_scored(whole: Capture, stripped: Capture) -> None:
    # That of a whole capture is that of its description, as it always was.
    assert whole.digest == sha256_json(json.loads((whole.root / "capture.json").read_text()))
    assert stripped.digest != whole.digest
    assert not whole.lacks_masks
    assert stripped.lacks_masks
    # Other truth decides no score.
    shutil.rmtree(whole.root / "truth" / "clean")
    (whole.root / "truth" / "hands.npz").unlink()
    assert open_capture(whole.root).digest == whole.digest


def test_a_capture_that_never_had_exact_masks_is_whole(make_capture: CaptureMaker) -> None:
    capture = make_capture("video", frames=20, size=48)
    assert capture.digest == sha256_json(capture.info.to_json())
    assert not check_capture(capture.root).findings


def test_a_check_names_truth_that_is_listed_and_not_there(stripped: Capture, capsys) -> None:
    assert main(["data", "check", str(stripped.root)]) == 0
    shown = capsys.readouterr().out
    for part in ("true_masks", "clean", "clean_masks", "true_hands"):
        assert f"digests.{part}: lists truth/" in shown
    assert "Scores are taken over the estimated masks" in shown


def test_results_on_other_masks_are_kept_apart(
    both: list[Results], whole: Capture, stripped: Capture, tmp_path: Path, capsys
) -> None:
    first, second = (results.captures[0] for results in both)
    assert (first.exact_masks, second.exact_masks) == (True, False)
    assert first.digest == whole.digest
    assert second.digest == stripped.digest
    assert first.key != second.key
    folders = [str(tmp_path / "out-one"), str(tmp_path / "out-two")]
    capsys.readouterr()
    assert main(["table", *folders]) == 0
    shown = capsys.readouterr().out
    assert "only rows of the same data are ranked together" in shown
    assert "scored on estimated masks" in " ".join(shown.split())
    assert main(["compare", *folders]) == 2
    assert "evaluated on different masks (exact and estimated)" in capsys.readouterr().err
    assert not verify_results(tmp_path / "out-two", [stripped.root]).discrepancies
    found = verify_results(tmp_path / "out-two", [whole.root]).discrepancies
    assert [item.what for item in found] == ["capture"]
    assert set(find_captures(both, [stripped.root, whole.root])) == {first.digest, second.digest}


def test_an_evaluation_without_the_truth_says_so_and_does_not_replace_the_other(
    both: list[Results], whole: Capture, stripped: Capture, tmp_path: Path, capsys
) -> None:
    words = ["evaluate", str(tmp_path / "one"), "-o", str(tmp_path / "out-one"), "--capture"]
    capsys.readouterr()
    assert main([*words, str(stripped.root)]) == 2
    said = capsys.readouterr().err
    assert "clip: its true masks are not there: scored on its estimated masks" in said
    assert "clip: data: it has changed, other masks are scored" in said


def test_a_result_that_was_changed_by_hand_is_in_no_table(
    both: list[Results], tmp_path: Path, capsys
) -> None:
    file = tmp_path / "out-one" / "results.json"
    value = json.loads(file.read_text())
    value["captures"][0]["frames"][0]["scores"]["psnr"] += 10
    file.write_text(json.dumps(value))
    commands = (["table"], ["report", "-o", str(tmp_path / "page")], ["curves"])
    for words in (*commands, ["compare", str(tmp_path / "out-two")]):
        assert main([*words, str(file.parent)]) == 1
        assert "the result was changed by hand" in capsys.readouterr().err
