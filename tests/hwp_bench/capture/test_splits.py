"""Splits: the rule, the files, the audit. Oracle: set arithmetic."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_captures import CaptureMaker

from hwp_bench.base.errors import BadSplit
from hwp_bench.base.packages import data_folder
from hwp_bench.capture.splits import (
    Split,
    audit_split,
    contiguous_split,
    read_splits,
    split_for,
    write_splits,
)
from hwp_bench.taxonomy import catalogue


@given(st.integers(10, 20_000))
def test_parts_are_disjoint_contiguous_and_complete(count: int) -> None:
    split = contiguous_split("x", count)
    frames = [*split.train, *split.validation, *split.test]
    assert frames == list(range(count))
    assert split.train_range == (0, int(count * 8 / 10))
    assert split.test_range == (int(count * 9 / 10), count)


@given(st.integers(10, 2000), st.integers(1, 300))
def test_a_guard_gap_leaves_out_exactly_the_frames_before_each_border(
    count: int, guard: int
) -> None:
    try:
        split = contiguous_split("x", count, guard=guard)
    except BadSplit:
        assert guard >= count * 9 // 10 - count * 8 // 10 or guard >= count * 8 // 10
        return
    plain = contiguous_split("x", count)
    assert set(plain.train) - set(split.train) == set(plain.train[-guard:])
    assert set(plain.validation) - set(split.validation) == set(plain.validation[-guard:])
    assert list(plain.test) == list(split.test)


@pytest.mark.parametrize("count", [1, 2, 9])
def test_a_capture_that_is_too_short_is_refused(count: int) -> None:
    with pytest.raises(BadSplit, match="at least 10 frames"):
        contiguous_split("x", count)


def test_overlap_and_overflow_are_refused() -> None:
    for ranges in [
        ((0, 9), (8, 10), (10, 12)),
        ((0, 8), (8, 10), (10, 13)),
        ((0, 8), (8, 8), (8, 9)),
    ]:
        with pytest.raises(BadSplit):
            Split("x", 12, *ranges)


def test_the_shipped_split_file_is_the_rule_for_the_eleven_captures() -> None:
    splits = read_splits(data_folder("splits") / "hwp-v1.json")
    assert list(splits) == list(catalogue())
    for entry in catalogue().values():
        assert splits[entry.id] == contiguous_split(entry.id, entry.frame_count)


def test_an_edited_split_file_is_refused(tmp_path: Path) -> None:
    path = write_splits(tmp_path / "s.json", [contiguous_split("a", 100)])
    assert read_splits(path)["a"] == contiguous_split("a", 100)
    value = json.loads(path.read_text())
    value["splits"][0]["train"] = [0, 79]
    path.write_text(json.dumps(value))
    with pytest.raises(BadSplit, match="does not match"):
        read_splits(path)
    value["splits"][0]["train"] = [0]
    path.write_text(json.dumps(value))
    with pytest.raises(BadSplit, match=r"a\.train: is \[0\], expected a list of 2"):
        read_splits(path)
    value["splits"][0]["train"] = [0, "x"]
    path.write_text(json.dumps(value))
    with pytest.raises(BadSplit, match=r"a\.train\[1\]: is 'x', expected an integer at least 0"):
        read_splits(path)


def test_a_capture_of_another_length_or_name_is_refused() -> None:
    splits = {"a": contiguous_split("a", 100)}
    assert split_for("a", 100, splits) is splits["a"]
    with pytest.raises(BadSplit, match="99 frames where its split is made for 100"):
        split_for("a", 99, splits)
    with pytest.raises(BadSplit, match="not in the split file"):
        split_for("b", 100, splits)


def test_the_audit_proves_and_reports(make_capture: CaptureMaker) -> None:
    capture = make_capture("clean", frames=40)
    report = audit_split(capture, contiguous_split("clean", 40, guard=2), threshold=1.0)
    assert report.ok
    assert report.counts == {"train": 30, "validation": 2, "test": 4}
    assert report.left_out == (30, 31, 34, 35)
    assert report.near_duplicates == ()
    # Neighbouring frames move by a quarter of a pixel: a wide threshold must find them.
    wide = audit_split(capture, contiguous_split("clean", 40), threshold=15.0)
    assert wide.near_duplicates
    assert all(test >= 36 > other for test, other, _ in wide.near_duplicates)
    assert wide.guard_needed == least_gap(40, {other for _, other, _ in wide.near_duplicates})


def least_gap(count: int, others: set[int]) -> int | None:
    """The smallest gap whose split has none of some frames in training and validation."""
    for gap in range(count):
        try:
            split = contiguous_split("x", count, guard=gap)
        except BadSplit:
            break
        if not others & {*split.train, *split.validation}:
            return gap
    return None


@pytest.mark.parametrize(
    ("copied", "gap"), [((30,), 2), ((35,), 1), ((30, 35), 2), ((29, 33), 3), ((28,), None)]
)
def test_the_gap_that_removes_near_copies_is_one_that_a_split_can_have(
    make_capture: CaptureMaker, copied: tuple[int, ...], gap: int | None
) -> None:
    """Of 40 frames 32 are for training and 4 for validation."""
    capture = make_capture(frames=40)
    frames = capture.root / "frames"
    for number, other in enumerate(copied):
        (frames / f"{38 + number:06d}.png").write_bytes((frames / f"{other:06d}.png").read_bytes())
    report = audit_split(capture, contiguous_split("tiny", 40), threshold=0.5)
    assert [other for _, other, _ in report.near_duplicates] == list(copied)
    assert report.guard_needed == gap == least_gap(40, set(copied))


def test_a_perturbed_test_clip_is_not_fair(make_capture: CaptureMaker) -> None:
    severity = (0,) * 18 + (0, 2)
    capture = make_capture(perturbations={"motion_blur": severity, "illumination": None})
    report = audit_split(capture, contiguous_split("tiny", 20))
    assert not report.ok
    assert report.perturbed_test == ((19, "motion_blur"),)
    assert report.unknown_severity == ("illumination",)


def test_an_exact_copy_across_the_border_is_found(make_capture: CaptureMaker) -> None:
    capture = make_capture(frames=20)
    source = capture.root / "frames" / "000005.png"
    (capture.root / "frames" / "000018.png").write_bytes(source.read_bytes())
    report = audit_split(capture, contiguous_split("tiny", 20), threshold=0.5)
    assert [(test, other) for test, other, _ in report.near_duplicates] == [(18, 5)]
    assert report.near_duplicates[0][2] == pytest.approx(0, abs=1e-5)


def test_perceptual_hashes_see_through_exposure(make_capture: CaptureMaker) -> None:
    # A brighter copy of a training frame: far in RMS, the same in its hash. Oracle: OpenCV's
    # own comparison of hashes.
    import cv2

    from hwp_bench.base.images import read_rgb, write_image

    capture = make_capture(frames=20, size=64)
    rng = np.random.default_rng(0)
    frames = capture.root / "frames"
    for frame in range(20):  # unlike each other
        noise = cv2.resize(rng.integers(0, 200, (6, 6, 3)).astype(np.uint8), (64, 64))
        write_image(frames / f"{frame:06d}.png", noise)
    brighter = np.clip(read_rgb(frames / "000005.png") * 1.2 + 10, 0, 255).astype(np.uint8)
    write_image(frames / "000018.png", brighter)
    report = audit_split(capture, contiguous_split("tiny", 20))
    assert report.near_duplicates == ()
    assert [(test, other) for test, other, _ in report.same_hashes] == [(18, 5)]
    assert report.guard_needed_by_hash is None
    hasher = cv2.img_hash.PHash_create()
    first, second = (
        hasher.compute(read_rgb(frames / name)[:, :, ::-1].copy())
        for name in ("000005.png", "000018.png")
    )
    assert report.same_hashes[0][2] == hasher.compare(first, second)
