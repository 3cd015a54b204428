"""Verification. Oracle: an untouched result holds; every kind of tampering is named.

scikit-image's PSNR and SSIM of scored pixels. Oracle: the toolkit's own scores, to 1e-9.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_captures import CaptureMaker
from toy_method import write_toy_method

from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.cli.main import main
from hwp_bench.evaluation.verify import CROSS_SAMPLE, reference_scores, sample_frames
from hwp_bench.metrics import score
from hwp_bench.metrics.score import score_frame
from hwp_bench.results import read_results, write_results


@pytest.fixture
def capture(make_capture: CaptureMaker) -> Capture:
    return make_capture("tiny", frames=20, size=32)


@pytest.fixture
def result(capture: Capture, tmp_path: Path) -> Path:
    method, out = write_toy_method(tmp_path / "toy"), tmp_path / "out"
    assert main(["evaluate", str(method), "--capture", str(capture.root), "-o", str(out)]) == 0
    return out


def verify(result: Path, capture: Capture, capsys) -> tuple[int, dict]:
    capsys.readouterr()
    status = main(["verify", str(result), "--capture", str(capture.root.parent), "--json"])
    return status, json.loads(capsys.readouterr().out)[0]


def edit(result: Path, change) -> None:
    file = result / "results.json"
    value = json.loads(file.read_text())
    change(value)
    file.write_text(json.dumps(value))


def test_an_untouched_result_holds(result: Path, capture: Capture, capsys) -> None:
    status, found = verify(result, capture, capsys)
    assert (status, found["discrepancies"]) == (0, [])
    assert (found["captures"], found["frames"], found["notes"]) == (1, 2, [])
    assert main(["verify", str(result), "--capture", str(capture.root)]) == 0
    out = capsys.readouterr().out
    assert "holds (1 captures, 2 frames)" in out
    assert "scikit-image agrees on PSNR and SSIM of 2 frames" in out
    assert found["cross_checked"] == 2


def test_a_run_that_may_have_begun_with_anothers_cache_is_named(result, capture, capsys) -> None:
    edit(result, lambda value: value["environment"].pop("caches"))
    _, found = verify(result, capture, capsys)
    assert any("code that another method left may have run" in note for note in found["notes"])


@pytest.mark.parametrize(("formula", "metric"), [("ssim_map", "ssim"), ("squared_error", "psnr")])
def test_a_fault_of_our_own_formula_is_found_out(
    capture: Capture, tmp_path: Path, capsys, monkeypatch, formula: str, metric: str
) -> None:
    right = getattr(score, formula)
    monkeypatch.setattr(score, formula, lambda *args, **named: right(*args, **named) * 0.999)
    method, out = write_toy_method(tmp_path / "toy"), tmp_path / "out"
    assert main(["evaluate", str(method), "--capture", str(capture.root), "-o", str(out)]) == 0
    status, found = verify(out, capture, capsys)
    assert status == 1
    whats = [item["what"] for item in found["discrepancies"]]
    assert whats == [f"frame {frame}, {metric} by scikit-image" for frame in (18, 19)]


#: Edits of a capture, and the part that must be named.
CAPTURE_EDITS = (
    (lambda c: c["frames"][1]["scores"].update(psnr=40.0), "frame 19, psnr"),
    (lambda c: c["frames"][0]["scores"].update(other=1.0), "frame 18, other"),
    (lambda c: c["frames"][0].update(failure="gone"), "frame 18, failure"),
    (lambda c: c.update(predictions_digest="0"), "predictions"),
    (lambda c: c.update(split_digest="0"), "split"),
    (lambda c: c.update(digest="0"), "capture"),
    (lambda c: c["frames"].pop(), "frames"),
    (lambda c: c["frames"][0].update(frame=99), "frames"),
)


def test_an_edited_result_is_found_out(result, capture, capsys) -> None:
    before = (result / "results.json").read_bytes()
    for change, what in CAPTURE_EDITS:
        (result / "results.json").write_bytes(before)
        edit(result, lambda value, change=change: change(value["captures"][0]))
        status, found = verify(result, capture, capsys)
        assert status == 1
        assert what in {item["what"] for item in found["discrepancies"]}
        assert found["discrepancies"][0]["capture"] == "tiny"


#: Each edit moves a number, a label or a rank, and the part that must be named.
EDITS = {
    "perturbations emptied": (lambda v: v["captures"][0]["perturbations"].clear(), "perturbations"),
    "other hands": (lambda v: v["captures"][0].update(hands="both"), "hands"),
    "masks of another kind": (lambda v: v["captures"][0].update(exact_masks=True), "exact_masks"),
    "made by somebody": (lambda v: v["captures"][0].update(made_by="video 1"), "made_by"),
    "a metric removed": (
        lambda v: [frame["scores"].pop("ssim_full") for frame in v["captures"][0]["frames"]],
        "frame 18, ssim_full",
    ),
    "a capture left out": (lambda v: v["captures"].clear(), "digest"),
    "clean as perturbed": (lambda v: v.update(frames="clean"), "key"),
    "another suite": (lambda v: v.update(suite="smoke"), "suite"),
    "another budget": (lambda v: v["budget"].update(seconds=1.0), "key"),
    "another seed": (lambda v: v.update(seed=1), "key"),
    "another method": (lambda v: v["method"].update(name="other"), "key"),
    "other code of the method": (lambda v: v["method"].update(digest="0"), "key"),
    "another title": (lambda v: v["method"].update(title="Other"), "tables/overall.md"),
    "another preset": (lambda v: v["method"].update(preset="other"), "digest"),
    "other settings": (lambda v: v["method"]["settings"].update(fast=True), "key"),
    "a faster fit": (
        lambda v: v["captures"][0].update(fit_seconds=0.1),
        "result.json, fit_seconds",
    ),
    "another start": (lambda v: v.update(started="2020-01-01T00:00:00+00:00"), "digest"),
    "a better curve": (
        lambda v: v["captures"][0]["curve"].append(
            {"step": 1, "seconds": 1.0, "peak_memory": 1, "scores": {"psnr": 99.0}}
        ),
        "result.json, curve",
    ),
    "a method that failed": (lambda v: v["captures"][0].update(failure="crashed"), "failure"),
    "no digest": (lambda v: v.pop("digest"), "digest"),
}


def test_every_edit_that_moves_a_number_or_label_is_found_out(
    result: Path, capture: Capture, tmp_path: Path, capsys
) -> None:
    assert (result / "tables" / "overall.md").is_file()
    for name, (change, what) in EDITS.items():
        place = tmp_path / name
        shutil.copytree(result, place)
        edit(place, change)
        status, found = verify(place, capture, capsys)
        whats = {item["what"] for item in found["discrepancies"]}
        assert status == 1, name
        assert {what, "digest"} <= whats, (name, whats)


def test_a_careful_forger_is_found_out_by_what_can_be_computed(
    result: Path, capture: Capture, capsys
) -> None:
    """The digest, the tables and the copies of an edited result are made to fit."""
    for change, what in (
        (lambda v: v["captures"][0]["perturbations"].clear(), "perturbations"),
        (lambda v: v["captures"][0]["frames"][0]["scores"].update(psnr=40.0), "frame 18, psnr"),
        (lambda v: v["budget"].update(seconds=1.0), "key"),
        (lambda v: v.update(suite="smoke"), "suite"),
    ):
        before = (result / "results.json").read_bytes()
        edit(result, change)
        forged = read_results(result)
        write_results(result / "results.json", forged)
        (result / "captures" / "tiny" / "result.json").unlink(missing_ok=True)
        shutil.rmtree(result / "tables", ignore_errors=True)
        status, found = verify(result, capture, capsys)
        assert status == 1
        assert what in {item["what"] for item in found["discrepancies"]}
        (result / "results.json").write_bytes(before)


def test_an_edited_table_or_copy_is_found_out(result: Path, capture: Capture, capsys) -> None:
    table = result / "tables" / "captures.csv"
    table.write_text(table.read_text().replace("Toy", "Best"))
    copy = result / "captures" / "tiny" / "result.json"
    copy.write_text(copy.read_text().replace('"steps": 100', '"steps": 7'))
    status, found = verify(result, capture, capsys)
    assert status == 1
    whats = {item["what"] for item in found["discrepancies"]}
    assert whats == {"tables/captures.csv", "result.json, steps"}
    copy.write_text("[")
    assert verify(result, capture, capsys)[0] == 1


def test_edited_predictions_and_captures_are_found_out(result, capture, capsys) -> None:
    picture = result / "captures" / "tiny" / "predictions" / "000018.png"
    write_image(picture, np.zeros((32, 32, 3), np.uint8))
    status, found = verify(result, capture, capsys)
    assert status == 1
    whats = {item["what"] for item in found["discrepancies"]}
    assert {"predictions", "frame 18, psnr"} <= whats
    assert not any("frame 19" in what for what in whats)
    picture.unlink()
    whats = {item["what"] for item in verify(result, capture, capsys)[1]["discrepancies"]}
    assert "frame 18, failure" in whats
    write_image(capture.root / "frames" / "000003.png", np.zeros((32, 32, 3), np.uint8))
    status, found = verify(result, capture, capsys)
    assert (status, found["frames"]) == (1, 0)
    assert [item["what"] for item in found["discrepancies"]] == ["capture"]


def test_other_code_protocols_and_missing_captures_are_named(result, capture, capsys) -> None:
    edit(result, lambda value: value["protocols"].clear())
    edit(result, lambda value: value["environment"].update(code="0"))
    edit(result, lambda value: value["environment"]["packages"].update(numpy="0.1"))
    status, found = verify(result, capture, capsys)
    assert status == 1
    # The key binds the protocols, the digest everything.
    assert [item["what"] for item in found["discrepancies"]] == ["protocols", "key", "digest"]
    assert "other code" in found["notes"][0]
    assert "numpy 0.1" in found["notes"][1]
    assert main(["verify", str(result)]) == 2
    assert "Say where its captures lie with --capture" in capsys.readouterr().err
    shutil.rmtree(capture.root)
    assert main(["verify", str(result), "--capture", str(capture.root.parent)]) == 2


def test_a_name_cannot_lead_out_of_the_folder(result, capture, capsys) -> None:
    edit(result, lambda value: value["captures"][0].update(id="../../elsewhere"))
    status, found = verify(result, capture, capsys)
    assert status == 1
    assert found["discrepancies"][0]["found"] == "no capture of this id"


@given(st.integers(0, 2**32 - 1), st.integers(12, 60), st.integers(12, 60), st.booleans())
@settings(max_examples=40, deadline=None)
def test_both_agree_wherever_the_hand_is(seed: int, height: int, width: int, exact: bool) -> None:
    rng = np.random.default_rng(seed)
    target, prediction = rng.integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    mask = np.zeros((height, width), np.uint8)
    top, left = rng.integers(0, height - 3), rng.integers(0, width - 3)
    mask[top : top + rng.integers(3, 30), left : left + rng.integers(3, 30)] = 255
    mask[rng.random(mask.shape) < 0.02] = 127 if exact else 0
    mask[top : top + 3, left : left + 3] = 255
    expected = score_frame(prediction, target, mask, coverage=exact)
    found = reference_scores(prediction, target, mask, coverage=exact)
    assert found == pytest.approx({name: expected[name] for name in found}, abs=1e-9)


def test_equal_images_have_the_cap_and_one() -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    mask = np.full((20, 30), 255, np.uint8)
    scores = reference_scores(image, image, mask, coverage=True)
    assert scores == {"psnr": 100.0, "ssim": pytest.approx(1.0, abs=1e-12)}


def test_a_sample_is_even_and_bounded() -> None:
    assert sample_frames(1) == [0]
    assert sample_frames(3) == [0, 1, 2]
    assert sample_frames(10) == [0, 3, 6, 9]
    assert len(sample_frames(1000)) == CROSS_SAMPLE
