"""The pre-pass on frames with injected perturbations. Oracle: what was injected."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from lit_hand import (
    FRAMES,
    HIT,
    SIZE,
    Lit,
    as_input,
    cameras,
    check_ranges,
    developed,
    hand_parameters,
    only,
)
from painted import painted_info

from hwp_bench.base.errors import BadInput, ShapeMismatch
from hwp_bench.capture import CaptureWriter, open_capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands import load_template
from hwp_bench.hands.anchors import HandSurfaces
from wildghand.prepass import (
    FrameAssessment,
    PrepassInput,
    capture_input,
    judge_frames,
)
from wildghand.prepass.measurements import interior

SPARED = np.setdiff1d(np.arange(FRAMES), np.arange(7, 15))


def without_tints(given: PrepassInput, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """The weights of pixels that no tint lowers."""
    monkeypatch.setattr("wildghand.prepass.weights.TINT_SCALE", 1e6)
    return judge_frames(given).pixel_weights


def test_clean_frames_are_judged_clean(lit_frames: Lit) -> None:
    judgement = judge_frames(as_input(developed(lit_frames[0]), lit_frames[1]))
    check_ranges(judgement, FRAMES)
    assert judgement.usable.all()
    assert (judgement.clean > 0.5).all()
    assert not judgement.refine_pose.any()
    assert np.abs(judgement.log_gains).max() < 0.05
    assert judgement.pixel_weights[lit_frames[1]].mean() > 0.85 * 255


def test_known_gains_are_recovered_to_0_05(lit_frames: Lit) -> None:
    gains = np.zeros((FRAMES, 3))
    gains[HIT] = np.array([-0.5, -0.35, -0.2]) + np.linspace(-0.3, 0.3, len(HIT))[:, None]
    linear = lit_frames[0] * np.exp(gains)[:, None, None]
    judgement = judge_frames(as_input(developed(linear), lit_frames[1]))
    check_ranges(judgement, FRAMES)
    np.testing.assert_allclose(judgement.log_gains, gains, atol=0.05)
    assert judgement.clean[HIT].max() < judgement.clean[SPARED].min()
    assert (judgement.omega_dropout[SPARED] == 1.0).all()


def test_blurred_frames_are_flagged_and_measured(lit_frames: Lit) -> None:
    length = 9
    linear = lit_frames[0].copy()
    kernel = np.full((1, length), 1.0 / length)
    for frame in HIT:
        linear[frame] = cv2.filter2D(linear[frame], -1, kernel)
    judgement = judge_frames(as_input(developed(linear), lit_frames[1]))
    check_ranges(judgement, FRAMES)
    assert (judgement.blur_deviation[HIT] > 3).all()
    assert (judgement.clean[HIT] < 0.5).all()
    assert (judgement.clean[SPARED] > 0.5).all()
    assert (judgement.omega_dropout[HIT] == 0).all()
    # A streak wider than a finger never shows the finger's full colour: the extent is low.
    assert (judgement.blur_extent[HIT] > 0.5 * length).all()
    assert (judgement.blur_extent[HIT] < 1.1 * length).all()
    assert judgement.blur_extent[SPARED].max() < 2.0


def test_covered_pixels_lose_their_weight(lit_frames: Lit) -> None:
    linear, masks = lit_frames[0].copy(), lit_frames[1].copy()
    covered = np.zeros_like(masks)
    for frame in HIT:
        rows, columns = np.nonzero(masks[frame])
        middle = np.median(rows).astype(int), np.median(columns).astype(int)
        box = np.s_[middle[0] - 9 : middle[0] + 9, middle[1] - 9 : middle[1] + 9]
        linear[frame][box] = [0.05, 0.1, 0.4]
        covered[frame][box] = masks[frame][box]
        # The segmenter takes the left half of the object for hand.
        masks[frame][box][:, 9:] = False
    judgement = judge_frames(as_input(developed(linear), masks))
    check_ranges(judgement, FRAMES)
    weights = judgement.pixel_weights[HIT]
    visible = lit_frames[1][HIT] & ~covered[HIT]
    assert weights[covered[HIT]].mean() < 0.1 * 255
    assert weights[visible].mean() > 0.7 * 255
    assert (judgement.hidden_deviation[HIT] > 3).all()
    assert (judgement.misplacement_deviation[HIT] < 3).all()
    assert judgement.clean[HIT].max() < judgement.clean[SPARED].min()


def test_what_looks_odd_in_a_clean_frame_keeps_its_weight(
    lit_frames: Lit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A spot of another brightness, as a nail has that is a little off its place."""
    linear, masks = lit_frames
    linear, spot = linear.copy(), np.zeros_like(masks)
    for frame in (*HIT.tolist(), int(SPARED[2])):
        rows, columns = np.nonzero(masks[frame])
        middle = np.median(rows).astype(int), np.median(columns).astype(int)
        spot[frame, middle[0] - 1 : middle[0] + 2, middle[1] - 1 : middle[1] + 2] = True
    spot &= masks
    linear[spot] *= 1.4
    linear[HIT] *= 0.3  # the light changes: these frames are not clean
    given = as_input(developed(linear), masks)
    judgement = judge_frames(given)
    monkeypatch.setattr("wildghand.prepass.weights.CLEAN_SCALE", 1.0)
    strict = judge_frames(given)
    np.testing.assert_array_equal(judgement.clean, strict.clean)
    assert (judgement.clean[HIT] < 0.5).all()
    frame = SPARED[2]
    assert judgement.clean[frame] > 0.8
    mean = [one.pixel_weights[frame][spot[frame]].mean() / 255 for one in (judgement, strict)]
    assert mean[0] > 0.8, mean
    assert mean[1] < 0.3, mean
    np.testing.assert_array_equal(judgement.pixel_weights[HIT], strict.pixel_weights[HIT])


def test_an_object_where_no_clean_frame_shows_the_hand_is_not_learnt_as_skin(
    lit_frames: Lit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lower third of the hand shows in perturbed frames alone, and there under wood."""
    linear, masks = lit_frames[0].copy(), lit_frames[1].copy()
    covered = np.zeros_like(masks)
    for frame in range(FRAMES):
        start = int(np.quantile(np.nonzero(masks[frame])[0], 0.7))
        if frame in HIT:
            covered[frame, start:] = masks[frame, start:]
            linear[frame][covered[frame]] = [0.5, 0.45, 0.2]
        else:
            masks[frame, start:] = False
    given = as_input(developed(linear), masks)
    weights = judge_frames(given).pixel_weights[HIT]
    assert weights[covered[HIT]].mean() < 0.03 * 255
    assert weights[lit_frames[1][HIT] & ~covered[HIT]].mean() > 0.7 * 255
    # What the test is about: a model that has learnt the object finds less wrong with it.
    blind = without_tints(given, monkeypatch)[HIT]
    assert blind[covered[HIT]].mean() > 5.0 * weights[covered[HIT]].mean()


def test_tints_that_every_frame_shows_are_not_held_against_a_place(
    lit_frames: Lit, monkeypatch: pytest.MonkeyPatch
) -> None:
    linear, masks = lit_frames[0].copy(), lit_frames[1]
    surfaces = HandSurfaces({"right": load_template("anny", "right")}, 0.004)
    clip = cameras()
    footprints = list(
        surfaces.footprints(
            {"right": hand_parameters()}, clip.Ks, clip.viewmats, np.arange(FRAMES), (SIZE, SIZE)
        )
    )
    # A twentieth of the places that all frames show, as red as nails may be.
    often = np.bincount(np.concatenate([np.unique(drawn.cells) for drawn in footprints]))
    chosen = np.flatnonzero(often == FRAMES)[::20]
    painted = np.zeros_like(masks)
    for frame, drawn in enumerate(footprints):
        painted[frame].reshape(-1)[drawn.pixels[np.isin(drawn.cells, chosen)]] = True
    linear[painted] *= [1.0, 0.6, 0.6]
    given = as_input(developed(linear), masks)
    tinted = judge_frames(given).pixel_weights[painted]
    untinted = without_tints(given, monkeypatch)[painted]
    assert painted.sum() > 500
    # Measured against the skin alone they would keep a hundredth.
    assert tinted.astype(float).mean() > 0.8 * untinted.astype(float).mean()


def test_beyond_the_silhouette_skin_keeps_its_weight_and_leaves_lose_it(lit_frames: Lit) -> None:
    linear, masks = lit_frames[0].copy(), lit_frames[1].copy()
    skin, leaf = np.zeros_like(masks), np.zeros_like(masks)
    skin[HIT, 2:8, 2:8] = leaf[HIT, 2:8, 12:18] = True
    assert not (masks & (skin | leaf)).any()
    linear[skin] = linear[masks].mean(axis=0)
    linear[leaf] = [0.1, 0.3, 0.05]
    given = as_input(developed(linear), masks | skin | leaf)
    weights = judge_frames(given).pixel_weights
    assert weights[skin].mean() > 0.8 * 255
    assert weights[leaf].mean() < 0.05 * 255
    assert (weights[~(masks | skin | leaf)] == 255).all()


@pytest.mark.parametrize("brightness", [0.5, 0.8])
def test_shade_is_no_tint(
    lit_frames: Lit, brightness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    linear = lit_frames[0].copy()
    linear[HIT, :, : SIZE // 2] *= brightness
    given = as_input(developed(linear), lit_frames[1])
    shown = lit_frames[1][HIT]
    tinted = judge_frames(given).pixel_weights[HIT][shown]
    untinted = without_tints(given, monkeypatch)[HIT][shown]
    # Half the light leaves a sensor's noise a larger share of the colour, hence not 1.
    assert tinted.astype(float).mean() > 0.9 * untinted.astype(float).mean()


def test_misplaced_hands_ask_for_refinement(lit_frames: Lit) -> None:
    given = as_input(developed(lit_frames[0]), lit_frames[1])
    hand = hand_parameters()
    transl = hand.transl.copy()
    transl[HIT, 0] += 0.012
    judgement = judge_frames(replace(given, hands={"right": replace(hand, transl=transl)}))
    check_ranges(judgement, FRAMES)
    assert np.flatnonzero(judgement.refine_pose).tolist() == HIT.tolist()
    assert (judgement.clean[HIT] < 0.5).all()
    assert judgement.clean[HIT].max() < judgement.clean[SPARED].min()


def test_same_frames_same_judgement_on_any_number_of_threads(
    lit_frames: Lit, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = as_input(developed(lit_frames[0]), lit_frames[1])
    first, second = (_judged_on(threads, given, monkeypatch) for threads in (1, 3))
    for field in fields(FrameAssessment):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name))


def _judged_on(
    threads: int, given: PrepassInput, monkeypatch: pytest.MonkeyPatch
) -> FrameAssessment:
    monkeypatch.setattr("torch.get_num_threads", lambda: threads)
    return judge_frames(given)


def test_many_pixels_are_judged_at_a_lower_resolution(
    lit_frames: Lit, monkeypatch: pytest.MonkeyPatch
) -> None:
    linear = lit_frames[0].copy()
    linear[HIT] *= np.exp(-0.6)
    given = as_input(developed(linear), lit_frames[1])
    monkeypatch.setattr("wildghand.prepass.judge.PIXEL_BUDGET", FRAMES * SIZE * SIZE // 3)
    judgement = judge_frames(given)
    check_ranges(judgement, FRAMES)
    assert judgement.pixel_weights.shape == (FRAMES, SIZE, SIZE)
    # Shrinking averages sRGB values, and half the pixels are left: 0.08 instead of 0.05.
    np.testing.assert_allclose(judgement.log_gains[HIT], -0.6, atol=0.08)
    assert judgement.clean[HIT].max() < judgement.clean[SPARED].min()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_frames_are_all_judged_clean(lit_frames: Lit, count: int) -> None:
    given = as_input(developed(lit_frames[0]), lit_frames[1])
    judgement = judge_frames(only(given, np.arange(count)))
    check_ranges(judgement, count)
    assert (judgement.clean == 1).all()
    assert (judgement.frame_weights == 1).all()
    assert (judgement.pixel_weights == 255).all()


def _black(given: PrepassInput) -> PrepassInput:
    given.images[5] = 0
    return given


def _constant(given: PrepassInput) -> PrepassInput:
    given.images[5] = 128
    return given


def _saturated(given: PrepassInput) -> PrepassInput:
    given.images[5] = 255
    return given


def _unmasked(given: PrepassInput) -> PrepassInput:
    given.masks[5] = 0
    return given


def _invalid(given: PrepassInput) -> PrepassInput:
    given.hands["right"].valid[5] = False
    return given


def _off_screen(given: PrepassInput) -> PrepassInput:
    given.hands["right"].transl[5] = [5.0, 0.0, 0.4]
    return given


def _behind(given: PrepassInput) -> PrepassInput:
    given.hands["right"].transl[5] = [0.0, 0.0, -1.0]
    return given


@pytest.mark.parametrize(
    "spoil", [_black, _constant, _saturated, _unmasked, _invalid, _off_screen, _behind]
)
def test_a_frame_without_a_hand_is_set_apart(lit_frames: Lit, spoil: object) -> None:
    assert callable(spoil)
    judgement = judge_frames(spoil(as_input(developed(lit_frames[0]), lit_frames[1])))
    check_ranges(judgement, FRAMES)
    assert np.flatnonzero(~judgement.usable).tolist() == [5]
    assert judgement.clean[5] == 0
    assert judgement.frame_weights[5] == pytest.approx(0.2)
    assert (judgement.pixel_weights[5] == 255).all()
    assert (np.delete(judgement.clean, 5) > 0.5).all()


def test_no_usable_frame_is_an_error(lit_frames: Lit) -> None:
    given = as_input(np.zeros((FRAMES, SIZE, SIZE, 3), dtype=np.uint8), lit_frames[1])
    with pytest.raises(BadInput, match="none of 24 training frames"):
        judge_frames(given)


def test_arrays_of_other_frames_are_refused(lit_frames: Lit) -> None:
    given = as_input(developed(lit_frames[0]), lit_frames[1])
    with pytest.raises(ShapeMismatch):
        replace(given, masks=given.masks[:3])


def test_frames_read_from_a_capture_are_judged_the_same(lit_frames: Lit, tmp_path: Path) -> None:
    images = developed(lit_frames[0])
    given = as_input(images, lit_frames[1])
    info = replace(painted_info("lit"), width=SIZE, height=SIZE, frame_count=FRAMES)
    with CaptureWriter(tmp_path / "lit", info, {"right": hand_parameters()}, cameras()) as writer:
        for frame in range(FRAMES):
            writer.frame(frame, images[frame])
            writer.mask(frame, given.masks[frame])
    split = contiguous_split("lit", FRAMES)
    judgement = judge_frames(capture_input(open_capture(tmp_path / "lit"), split.train))
    expected = judge_frames(only(given, split.train))
    assert judgement.indices.tolist() == split.train.tolist()
    # hands.npz may hold the parameters in single precision.
    np.testing.assert_allclose(judgement.clean, expected.clean, atol=1e-3)


def test_a_part_of_another_colour_in_every_frame_keeps_its_weight(lit_frames: Lit) -> None:
    """Cloth over the fingers, bare skin below, and a light that changes in some frames."""
    linear, masks = lit_frames[0].copy(), lit_frames[1]
    bare = np.zeros_like(masks)
    for frame in range(FRAMES):
        start = int(np.quantile(np.nonzero(masks[frame])[0], 0.7))
        bare[frame, start:] = masks[frame, start:]
        linear[frame][masks[frame] & ~bare[frame]] *= [0.12, 0.25, 0.12]
    linear[HIT] *= 0.3
    given = as_input(developed(linear), masks)
    weights = judge_frames(given).pixel_weights
    # The borders of hand and cloth move over the surface with the pose, and are left out.
    inner = np.stack([interior(part, 4) for part in bare])
    assert weights[SPARED][inner[SPARED]].mean() > 0.7 * 255
    assert weights[SPARED][(masks & ~bare)[SPARED]].mean() > 0.7 * 255


@pytest.mark.parametrize(("colour", "least", "most"), [(None, 0.5, 1.0), ((0.1, 0.1, 0.6), 0, 0.1)])
def test_a_place_that_no_clean_frame_shows_may_have_a_second_colour_of_the_hand(
    lit_frames: Lit, colour: tuple[float, ...] | None, least: float, most: float
) -> None:
    """Dark frames alone show a strip of the bare part: as bare as the rest of it, or painted."""
    linear, masks = lit_frames[0].copy(), lit_frames[1].copy()
    strip = np.zeros_like(masks)
    for frame in range(FRAMES):
        rows = np.nonzero(masks[frame])[0]
        below = np.zeros_like(masks[frame])
        below[int(np.quantile(rows, 0.6)) :] = True
        linear[frame][masks[frame] & ~below] *= [0.12, 0.25, 0.12]
        below[: int(np.quantile(rows, 0.8))] = False
        strip[frame] = masks[frame] & below
        if frame not in HIT:
            masks[frame] &= ~strip[frame]
        elif colour is not None:
            linear[frame][strip[frame]] = colour
    linear[HIT] *= 0.3
    weights = judge_frames(as_input(developed(linear), masks)).pixel_weights
    inner = np.stack([interior(part, 3) & part for part in strip])
    assert least * 255 <= weights[HIT][inner[HIT]].mean() <= most * 255
