"""Novelty of test pixels. Oracle: hands that turn by a known angle, masks that hide places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_results import drawn_results
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.base.errors import ShapeMismatch, UsageError
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands.articulation import axis_angle_to_matrix
from hwp_bench.metrics.protocol import PSNR_CAP
from hwp_bench.metrics.score import score_frame
from hwp_bench.report.pixel_tables import (
    BLURS,
    CLASSES,
    LIT,
    Novelty,
    band_power,
    classes_of,
    measure_novelty,
    outline_scores,
    spread_outwards,
)
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.results import Results, read_results, write_results


@pytest.fixture
def still(make_painted: Callable[..., Capture]) -> Capture:
    """The painted capture with the hand at rest in every frame."""
    painted = make_painted()
    hands = {
        side: replace(hand, pose=np.repeat(hand.pose[:1], len(hand.pose), axis=0))
        for side, hand in painted.hands.items()
    }
    return Capture(painted.root, painted.info, hands, painted.cameras)


def turned(capture: Capture, frames: list[int], degrees: float) -> Capture:
    """The capture with the hand turned about the viewing axis in some frames."""
    import torch
    from scipy.spatial.transform import Rotation

    (side, hand), pose = next(iter(capture.hands.items())), next(iter(capture.hands.values())).pose
    turn = axis_angle_to_matrix(torch.tensor([[0.0, 0.0, np.radians(degrees)]])).numpy()[0]
    pose = pose.copy()
    for frame in frames:
        pose[frame, 0] = Rotation.from_matrix(
            turn @ Rotation.from_rotvec(pose[frame, 0]).as_matrix()
        ).as_rotvec()
    return Capture(capture.root, capture.info, {side: replace(hand, pose=pose)}, capture.cameras)


def test_a_hand_that_stands_still_shows_nothing_new(still: Capture) -> None:
    split = contiguous_split(still.info.id, len(still))
    novelty = next(measure_novelty(still, split, [int(split.test[0])]))
    drawn = ~np.isnan(novelty.angle)
    inside = drawn & (still.mask(int(split.train[0])) > 127)
    assert inside.sum() > 200
    # Masks are of a hand that moves a little, so that each place is in some of them.
    assert np.median(novelty.angle[inside]) < 0.5
    assert np.median(novelty.seen[inside]) > 0.9
    assert np.isnan(novelty.seen[~drawn]).all()


def test_the_angle_is_that_of_the_turn(still: Capture) -> None:
    split = contiguous_split(still.info.id, len(still))
    test = int(split.test[0])
    capture = turned(still, [test], 30.0)
    novelty = next(measure_novelty(capture, split, [test]))
    known = (novelty.seen > 0.5) & ~np.isnan(novelty.angle)
    assert known.sum() > 200
    # A normal turns by as much as its part across the axis; none turns further than the hand.
    angles = novelty.angle[known]
    assert np.quantile(angles, 0.98) < 33.0
    assert np.median(angles) > 5.0
    # Turned by as much in one training frame, the pose is known.
    again = turned(still, [test, int(split.train[3])], 30.0)
    found = next(measure_novelty(again, split, [test]))
    same = found.angle[known & ~np.isnan(found.angle)]
    assert np.median(same) < np.median(angles)


def test_places_that_no_mask_shows_are_never_seen(
    still: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = contiguous_split(still.info.id, len(still))
    half = np.zeros(still.size, dtype=np.uint8)
    half[:, : still.size[1] // 2] = 255
    monkeypatch.setattr(Capture, "mask", lambda self, frame: half)
    novelty = next(measure_novelty(still, split, [int(split.test[0])]))
    columns = np.broadcast_to(np.arange(still.size[1]), still.size)
    drawn = ~np.isnan(novelty.angle)
    far = drawn & (columns > still.size[1] // 2 + 4)
    near = drawn & (columns < still.size[1] // 2 - 1)
    assert (novelty.seen[near] == 1.0).all()
    # The rear of a finger's cell may lie over the border; all others are new.
    assert np.mean(novelty.seen[far] == 0.0) > 0.9
    assert (novelty.angle[novelty.seen == 0.0] == 180.0).all()


SIZE = 64


def square(edge: int, color: tuple[int, int, int] = (200, 140, 110)) -> np.ndarray:
    """A hand of one colour over black: a square in the middle of the frame."""
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    first = (SIZE - edge) // 2
    image[first : first + edge, first : first + edge] = color
    return image


def coverage_of(image: np.ndarray) -> np.ndarray:
    """255 where the hand is; no pixel is mixed."""
    return np.where(image.max(axis=2) > 0, 255, 0).astype(np.uint8)


def test_the_truth_draws_nothing_outside() -> None:
    truth = square(30)
    found = outline_scores(truth, truth, coverage_of(truth), coverage=True)
    assert found is not None
    assert (found.psnr, found.drawn_outside, found.psnr_with_outside) == (PSNR_CAP, 0.0, PSNR_CAP)
    assert found.psnr_spread == PSNR_CAP


def test_a_hand_that_is_too_large_pays_for_what_is_outside() -> None:
    truth, large = square(30), square(40)
    found = outline_scores(large, truth, coverage_of(truth), coverage=True)
    assert found is not None
    assert found.psnr == PSNR_CAP
    ring = (40**2 - 30**2) / 30**2
    assert found.drawn_outside == pytest.approx(ring, abs=1e-12)
    power = np.mean((np.array([200, 140, 110]) / 255.0) ** 2)
    assert found.psnr_with_outside == pytest.approx(-10 * np.log10(ring * power), abs=1e-9)


def test_a_hand_that_is_too_small_gains_by_spreading() -> None:
    truth, small = square(30), square(26)
    found = outline_scores(small, truth, coverage_of(truth), coverage=True)
    assert found is not None
    power = np.mean((np.array([200, 140, 110]) / 255.0) ** 2)
    missing = (30**2 - 26**2) / 30**2
    assert found.psnr == pytest.approx(-10 * np.log10(missing * power), abs=1e-9)
    assert found.psnr_with_outside == found.psnr
    assert found.psnr_spread == PSNR_CAP


@given(seed=st.integers(0, 2**32 - 1), exact=st.booleans())
def test_the_psnr_is_the_headline_s_and_the_outside_only_adds_error(seed: int, exact: bool) -> None:
    random = np.random.default_rng(seed)
    mask = random.choice(np.array([0, 90, 200, 255], np.uint8), (SIZE, SIZE))
    mask[20:40, 20:40] = 255
    prediction, target = random.integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
    found = outline_scores(prediction, target, mask, coverage=exact)
    assert found is not None
    headline = score_frame(prediction, target, mask, coverage=exact)["psnr"]
    assert found.psnr == pytest.approx(headline, abs=1e-9)
    assert found.psnr_with_outside <= found.psnr + 1e-12


def test_the_uncertain_border_of_an_estimated_mask_is_not_outside() -> None:
    truth = square(30)
    mask = coverage_of(truth)
    near = outline_scores(square(34), truth, mask)
    far = outline_scores(square(36), truth, mask)
    assert near is not None
    assert far is not None
    assert near.drawn_outside == 0.0
    assert far.drawn_outside > 0.0


def test_a_rim_that_is_mixed_with_black_is_not_what_spreads() -> None:
    image = square(30)
    rim = square(30).max(axis=2) > 0
    rim[18:46, 18:46] = False
    image[rim] //= 4
    spread = spread_outwards(image, image.max(axis=2) > LIT)
    assert (spread == np.array([200, 140, 110])).all()


def test_a_black_frame_spreads_nothing() -> None:
    black, truth = np.zeros((SIZE, SIZE, 3), np.uint8), square(30)
    found = outline_scores(black, truth, coverage_of(truth), coverage=True)
    assert found is not None
    assert found.psnr_spread == found.psnr == found.psnr_with_outside


def test_a_frame_without_scored_pixels_and_one_of_another_size() -> None:
    truth = square(30)
    nothing = np.zeros((SIZE, SIZE), np.uint8)
    assert outline_scores(truth, truth, nothing, coverage=True) is None
    with pytest.raises(ShapeMismatch):
        outline_scores(truth[:-1], truth, coverage_of(truth), coverage=True)


MIDDLE = coverage_of(square(48))


def waves(length: float, amplitude: float = 30.0, shift: float = 0.0) -> np.ndarray:
    """Grey stripes of one wavelength, px, as a whole frame."""
    phase = 2 * np.pi * (np.arange(SIZE) + shift) / length
    line = np.rint(128 + amplitude * np.sin(phase)).astype(np.uint8)
    return np.repeat(np.broadcast_to(line, (SIZE, SIZE))[..., None], 3, axis=2)


def ratio_and_correlation(
    prediction: np.ndarray, truth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    found = band_power(prediction, truth, MIDDLE)
    assert found is not None
    return np.sqrt(found.drawn / found.true), found.both / np.sqrt(found.drawn * found.true)


@pytest.mark.parametrize(("length", "strongest"), [(3.0, 0), (6.5, 1), (13.0, 2)])
def test_a_band_holds_its_wavelength(length: float, strongest: int) -> None:
    """Oracle: the transfer function of a Gaussian blur, exp(-2 (pi sigma / wavelength)^2)."""
    found = band_power(waves(length), waves(length), MIDDLE)
    assert found is not None
    passed = np.exp(-2 * (np.pi * np.array(BLURS) / length) ** 2)
    expected = 0.5 * (30 / 255 * -np.diff(passed)) ** 2
    # Blurs at the border of the region are means over fewer pixels.
    np.testing.assert_allclose(found.true[strongest], expected[strongest], rtol=0.12)
    assert found.true.argmax() == expected.argmax() == strongest


def test_half_the_contrast_is_half_the_ratio_and_a_shift_is_no_structure() -> None:
    ratio, correlation = ratio_and_correlation(waves(6.5, 20.0), waves(6.5, 40.0))
    np.testing.assert_allclose(ratio[1], 0.5, atol=0.01)
    np.testing.assert_allclose(correlation[1], 1.0, atol=0.01)
    ratio, correlation = ratio_and_correlation(waves(6.5, 40.0, shift=6.5 / 4), waves(6.5, 40.0))
    np.testing.assert_allclose(ratio[1], 1.0, atol=0.05)
    assert abs(correlation[1]) < 0.1


def test_noise_is_amplitude_without_structure() -> None:
    """Oracle: independent noise adds its power, and lowers the correlation to 1 / ratio."""
    truth = waves(4.0, 20.0)
    noise = np.random.default_rng(0).normal(0.0, 20.0, truth.shape)
    noisy = np.clip(truth + noise, 0, 255).astype(np.uint8)
    ratio, correlation = ratio_and_correlation(noisy, truth)
    assert ratio[0] > 1.2
    np.testing.assert_allclose(correlation[0], 1.0 / ratio[0], rtol=0.1)


@given(seed=st.integers(0, 2**32 - 1))
def test_pixels_outside_of_the_mask_and_the_brightness_are_no_structure(seed: int) -> None:
    random = np.random.default_rng(seed)
    one, other = random.integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
    inside = (MIDDLE > 0)[..., None]
    first, second = (
        band_power(one, one, MIDDLE),
        band_power(np.where(inside, one, other), one, MIDDLE),
    )
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first, second)
    plain = np.full_like(one, random.integers(0, 256))
    flat = band_power(plain, one, MIDDLE)
    assert flat is not None
    np.testing.assert_allclose(flat.drawn, 0.0, atol=1e-20)


def test_who_draws_sharper_is_seen(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()

    def blurred(sigma: float) -> Callable[[int], np.ndarray]:
        return lambda frame: cv2.GaussianBlur(capture.frame(frame), (0, 0), sigma)

    draws = {"exact": capture.frame, "soft": blurred(0.7), "softer": blurred(1.5)}
    folders = [
        drawn_results(capture, tmp_path / name, make_results(name), draw)
        for name, draw in draws.items()
    ]
    table = make_table(TableRequest(folders, by="sharpness", captures=[capture.root]))
    assert [column.group for column in table.columns] == ["", *["Spectrum ratio"] * 3] + (
        ["Correlation"] * 3
    )
    rows = {row[0]: np.array(row[1:], dtype=float) for row in table.rows}
    np.testing.assert_allclose(rows["Exact"], 1.0, atol=1e-12)
    assert (rows["Softer"][:3] < rows["Soft"][:3]).all()
    assert (rows["Soft"][:3] < 1.0).all()
    with pytest.raises(UsageError, match="none of these captures"):
        make_table(TableRequest(folders, by="sharpness"))


def test_classes_are_those_of_the_edges() -> None:
    angle = np.array([[0.0, 5.0, 10.0, 39.9, 60.0, 180.0, np.nan]])
    seen = np.array([[1.0, 0.5, 0.2, 0.05, 0.01, 0.0, np.nan]])
    found = classes_of(Novelty(0, angle, seen), np.ones((1, 7), dtype=bool))
    names = [[CLASSES[place][1] for place in row] for row in found]
    assert names[0] == [
        "below 5°", "5° to 10°", "10° to 20°", "20° to 40°", "above 40°", "never seen",
        "off the posed hand",
    ]  # fmt: skip
    assert names[1] == [
        "in more than 50 %", "in 20 to 50 %", "in 5 to 20 %", "in 5 % or less", "in 5 % or less",
        "never", "off the posed hand",
    ]  # fmt: skip


def test_errors_are_pooled_by_class(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()
    perfect = drawn_results(capture, tmp_path / "a", make_results("perfect"), capture.frame)

    def off_by_20(frame: int) -> np.ndarray:
        image = capture.frame(frame)
        return (image + (image < 128) * 20 - (image >= 128) * 20).astype(np.uint8)

    off = drawn_results(capture, tmp_path / "b", make_results("off"), off_by_20)
    table = make_table(TableRequest([perfect, off], by="novelty", captures=[capture.root]))
    for what in dict.fromkeys(name for name, _ in CLASSES):
        rows = [row for row in table.rows if row[0] == what]
        for method, psnr in (("Perfect", PSNR_CAP), ("Off", -20 * np.log10(20 / 255))):
            mine = [row for row in rows if row[2] == method]
            assert sum(row[3] for row in mine) == pytest.approx(100.0)
            # Every pixel is off by as much, so every class has the same score.
            for row in mine:
                assert row[5] == pytest.approx(psnr, abs=1e-6)
        shares = [row[4] for row in rows if row[2] == "Off"]
        assert sum(shares) == pytest.approx(100.0)


@pytest.mark.parametrize("by", ["outline", "novelty", "sharpness"])
def test_captures_that_are_not_at_hand_are_named(
    by: str,
    make_painted: Callable[..., Capture],
    make_results: Callable[..., Results],
    tmp_path: Path,
) -> None:
    capture = make_painted()
    folder = drawn_results(capture, tmp_path / "a", make_results("mine"), capture.frame)

    def told() -> list[str]:
        table = make_table(TableRequest([folder], by=by, captures=[capture.root]))
        return [note for note in table.notes if note.startswith("Of ")]

    assert told() == []
    results = read_results(folder)
    far = replace(results.captures[0], id="far", digest="f" * 64)
    write_results(folder / "results.json", replace(results, captures=[*results.captures, far]))
    (note,) = told()
    assert note.startswith("Of 1 of 2 captures.")
    assert note.endswith(": far.")


def test_it_needs_captures_and_predictions(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()
    folder = drawn_results(capture, tmp_path / "a", make_results("perfect"), capture.frame)
    with pytest.raises(UsageError, match="none of these captures"):
        make_table(TableRequest([folder], by="novelty"))


def entry(capture: Capture, folder: Path, example: Results, grown: int) -> Path:
    """A result whose predictions are the hand over black, with some more pixels around it."""

    def draw(frame: int) -> np.ndarray:
        hand = (capture.scoring_mask(frame)[0] > 0).astype(np.uint8)
        around = cv2.dilate(hand, np.ones((3, 3), np.uint8), iterations=grown) if grown else hand
        skin = np.full_like(capture.frame(frame), 60)
        image = np.where(hand[..., None], capture.frame(frame), skin)
        return np.asarray(image * around[..., None])

    return drawn_results(capture, folder, example, draw)


def test_who_draws_larger_is_seen(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()
    folders = [
        entry(capture, tmp_path / name, make_results(name), grown)
        for name, grown in (("exact", 0), ("large", 4), ("larger", 8))
    ]
    table = make_table(TableRequest(folders, by="outline", captures=[capture.root]))
    rows = {row[0]: row[1:] for row in table.rows}
    exact, large, larger = rows["Exact"], rows["Large"], rows["Larger"]
    assert exact == (PSNR_CAP, 0.0, PSNR_CAP, pytest.approx(exact[3]))
    # In what the headline scores, the three are the same.
    assert exact[0] == large[0] == larger[0]
    assert 0.0 < large[1] < larger[1]
    assert exact[2] > large[2] > larger[2]


@pytest.mark.parametrize("by", ["outline", "novelty"])
def test_a_frame_that_one_method_leaves_out_counts_for_none(
    by: str,
    make_painted: Callable[..., Capture],
    make_results: Callable[..., Results],
    tmp_path: Path,
) -> None:
    capture = make_painted()
    last = contiguous_split(capture.info.id, len(capture)).test.tolist()[-1]

    def dark_at_last(frame: int) -> np.ndarray:
        return np.asarray(capture.frame(frame) // (4 if frame == last else 1))

    whole = drawn_results(capture, tmp_path / "a", make_results("whole"), dark_at_last)
    part = drawn_results(capture, tmp_path / "b", make_results("part"), capture.frame)
    (part / "captures" / capture.info.id / "predictions" / frame_name(last)).unlink()
    table = make_table(TableRequest([whole, part], by=by, captures=[capture.root]))
    place = [column.title for column in table.columns].index("PSNR [dB]")
    assert {row[place] for row in table.rows} == {PSNR_CAP}


def test_it_needs_the_captures_and_every_method_s_predictions(
    make_painted: Callable[..., Capture], make_results: Callable[..., Results], tmp_path: Path
) -> None:
    capture = make_painted()
    kept = entry(capture, tmp_path / "kept", make_results("kept"), 0)
    lost = entry(capture, tmp_path / "lost", make_results("lost"), 0)
    for path in (lost / "captures").rglob("*.png"):
        path.unlink()
    with pytest.raises(UsageError, match="predictions of every method"):
        make_table(TableRequest([kept], by="outline"))
    with pytest.raises(UsageError, match="predictions of every method"):
        make_table(TableRequest([kept, lost], by="outline", captures=[capture.root]))
