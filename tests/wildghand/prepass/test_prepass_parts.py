"""Parts of the pre-pass against other ways to the same number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hwp_bench.base.colors import linear_to_srgb
from hwp_bench.base.errors import BadInput
from hwp_bench.capture import Capture
from wildghand.prepass.assessment import PrepassSettings, densest, excess, normal_value
from wildghand.prepass.intensity import IntensitySamples, fit_intensity, shading_basis
from wildghand.prepass.judge import LEAST_FRAMES, clean_probability, clip_tolerance, evidence
from wildghand.prepass.measurements import border_width, capture_input, misplacement


def test_normal_values_of_a_normal_distribution() -> None:
    values = np.random.default_rng(1).normal(3.0, 0.5, 4000)
    outliers = np.full(2000, 40.0)
    middle, deviation = normal_value(np.concatenate([values, outliers, [np.nan]]), 0.35)
    assert middle == pytest.approx(3.0, abs=0.1)
    # 0.35 of all values are 0.525 of the sound ones: their half width is 0.71 deviations, and
    # 0.35 of a normal distribution would lie within 0.45.
    assert deviation == pytest.approx(0.5 * 0.71 / 0.45, rel=0.1)


@given(
    arrays(np.float64, st.integers(1, 40), elements=st.floats(-1e6, 1e6) | st.just(float("nan"))),
    st.floats(0.05, 1.0),
)
def test_excess_is_finite_and_ordered(values: np.ndarray, share: float) -> None:
    result = excess(values, share, 0.1)
    assert np.isfinite(result).all()
    assert (result >= 0).all()
    known = np.isfinite(values)
    order = np.argsort(values[known], kind="stable")
    assert (np.diff(result[known][order]) >= 0).all()


def test_densest_part_is_the_cluster() -> None:
    random = np.random.default_rng(2)
    values = np.concatenate([random.uniform(-2, 2, (12, 3)), random.normal(0.7, 0.01, (8, 3))])
    centre, part = densest(values, 0.35)
    np.testing.assert_allclose(centre, 0.7, atol=0.02)
    assert not part[:12].any()


def test_misplacement_grows_with_the_shift_and_ignores_what_is_hidden() -> None:
    hand = np.zeros((64, 64), dtype=bool)
    hand[20:44, 16:48] = True
    assert misplacement(hand, hand) == 0.0
    bitten = hand.copy()
    bitten[20:32] = False
    assert misplacement(bitten, hand) == 0.0
    shifts = [misplacement(np.roll(hand, shift, axis=1), hand) for shift in (2, 4, 6)]
    assert 0 < shifts[0] < shifts[1] < shifts[2]


def test_border_width_of_a_ramp() -> None:
    columns = np.arange(96) + 0.5
    mask = np.repeat((columns < 48)[None], 96, axis=0)
    widths = []
    for length in (4.0, 8.0):
        # A streak is straight in light.
        ramp = 0.05 + 0.5 * np.clip(0.5 - (columns - 48) / length, 0.0, 1.0)
        image = np.round(255 * linear_to_srgb(np.repeat(ramp[None], 96, axis=0)))
        image = np.repeat(image[..., None], 3, axis=2)
        widths.append(border_width(image.astype(np.uint8), mask))
    assert widths == pytest.approx([4.0, 8.0], rel=0.1)


def test_border_width_is_unknown_without_contrast() -> None:
    image = np.full((48, 48, 3), 90, dtype=np.uint8)
    mask = np.zeros((48, 48), dtype=bool)
    assert np.isnan(border_width(image, mask))
    mask[10:30, 10:30] = True
    assert np.isnan(border_width(image, mask))
    assert np.isnan(border_width(image, ~np.zeros((48, 48), dtype=bool)))


def test_evidence_is_shared_with_neighbours_only() -> None:
    deviation = np.array([0.0, 9.0, 0.0, 0.0])
    alone = np.log1p(9.0)
    shared = evidence([deviation], np.array([0, 1, 2, 9]), 9.0)
    np.testing.assert_allclose(shared, alone * np.array([0.25, 0.5, 0.25, 0.0]))
    # Neighbours speak up to the tolerance: on either side of an episode frames stay clean.
    limited = evidence([deviation], np.array([0, 1, 2, 9]), 1.2)
    np.testing.assert_allclose(limited, [0.3, 0.5 * alone, 0.3, 0.0])
    assert (clean_probability(limited, 1.2) > 0.9).tolist() == [True, False, True, True]
    # Beyond a gap a frame has no neighbour and speaks for itself.
    apart = evidence([deviation], np.array([0, 4, 8, 12]), 1.2)
    np.testing.assert_allclose(apart, alone * np.array([0.0, 1.0, 0.0, 0.0]))
    assert clean_probability(np.array([0.0, 1.2]), 1.2).tolist() == [1.0, 0.5]


@given(arrays(np.float64, st.integers(0, 12), elements=st.floats(0.0, 1e6)))
def test_most_frames_that_are_known_to_be_clean_are_judged_so(found: np.ndarray) -> None:
    least = PrepassSettings().tolerance
    tolerance = clip_tolerance(found, least)
    if len(found) < LEAST_FRAMES:
        assert tolerance == least
        return
    assert 2 * (clean_probability(found, tolerance) >= 0.5).sum() >= len(found)
    # It is no larger than it must be: as many are at it or above.
    assert tolerance == least or 2 * (found >= tolerance).sum() >= len(found)


@pytest.mark.parametrize("lit", [False, True])
def test_a_pale_palm_is_not_another_light(lit: bool) -> None:
    # Oracle: the gains that the samples were made with. Backs in 18 frames, palms in 6; the sides
    # of fingers, a tenth of both, tell which of two causes made the palms 2.5 times as bright.
    random = np.random.default_rng(11)
    normals = random.normal(size=(440, 3))
    normals[:, 2] = np.abs(normals[:, 2]) + 0.2
    normals[200:400, 2] *= -1.0
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    albedo = np.log([0.3, 0.17, 0.1]) + random.normal(0.0, 0.05, (440, 1))
    gains = np.zeros((24, 3))
    palms = np.arange(24) >= 18
    if lit:
        gains[palms] = 0.9
    else:
        albedo[200:400] += 0.9
    views = [[*(range(200, 400) if palm else range(200)), *range(400, 424)] for palm in palms]
    cells = np.array(views)
    light = albedo[cells] + gains[:, None] + random.normal(0.0, 0.02, (*cells.shape, 3))
    samples = IntensitySamples(
        np.arange(25) * cells.shape[1],
        cells.ravel(),
        light.reshape(-1, 3).astype(np.float32),
        shading_basis(normals[cells.ravel()]),
    )
    model = fit_intensity(samples, normals)
    np.testing.assert_allclose(model.gains, gains, atol=0.25)


def test_a_capture_of_another_edition_of_the_hand_is_refused(
    make_painted: Callable[..., Capture],
) -> None:
    capture = make_painted()
    model = replace(capture.info.hand_model, digest="0" * 64)
    info = replace(capture.info, hand_model=model)
    other = Capture(capture.root, info, capture.hands, capture.cameras)
    with pytest.raises(BadInput, match="another edition"):
        capture_input(other, np.arange(2))
