"""The texture's term. Oracle: a painted hand whose pose in every frame is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from painted_clip import (
    FRAMES,
    HAND,
    assert_says_nothing,
    assert_slopes_lead_down,
    fit_to_errors,
    footage,
    pictures,
    pixel_error,
    true_pixels,
)

from hwp_bench.importers.video.model import frame_variables
from hwp_bench.importers.video.pictures import TextureResidual
from hwp_bench.importers.video.residuals import OutlineResidual, signed_distance
from hwp_bench.importers.video.solve import FittedClip, fit_outline
from hwp_bench.importers.video.texture import smooth_within


def texture_of(fitted: FittedClip) -> TextureResidual:
    return TextureResidual(pictures(), fitted.model)


def test_a_painted_hand_comes_nearer_to_its_truth_than_by_its_outline() -> None:
    clip, windows, _, masks = footage()
    fields = np.stack([signed_distance(mask) for mask in masks])
    errors = []
    for painted in (False, True):
        fitted = fit_to_errors()
        contour = OutlineResidual(fields, clip.landmarks.detected, windows, HAND)
        fit_outline(fitted, contour, *([texture_of(fitted)] if painted else []))
        errors.append(pixel_error(fitted))
    # 0.78 and 0.93 px when this was written.
    assert errors[1] < 0.92 * errors[0]


def test_the_energy_and_its_slope_are_those_of_the_linearisation() -> None:
    # Zero where it was linearised; one step down the slope lowers it. Twice gives the same bits.
    fitted = fit_to_errors()
    assert_slopes_lead_down(fitted, [texture_of(fitted), texture_of(fitted)])
    assert frame_variables(fitted.model.variables).shape == (FRAMES, 51)


def test_the_mean_texture_is_what_was_painted() -> None:
    # True poses: light removed from both, picture and mean agree to a correlation of 0.9.
    clip = footage()[0]
    residual = texture_of(fit_to_errors())
    vertices = clip.vertices.astype(np.float32)
    drawn = [residual.draw(*parts) for parts in zip(vertices, true_pixels(), strict=True)]
    for _ in range(2):
        residual.collect([], (residual.seen(frame, one) for frame, one in enumerate(drawn)))
    for frame in range(0, len(drawn), 6):
        view = residual.view(frame, drawn[frame])
        expected, core = residual.expected(view, drawn[frame])
        assert core.sum() > 0.3 * view.region.sum()
        assert np.corrcoef(expected[core], view.detail[core])[0, 1] > 0.9


def test_a_frame_without_a_hand_has_no_energy() -> None:
    fitted = fit_to_errors()
    nothing = replace(pictures(), masks=np.zeros_like(pictures().masks))
    assert_says_nothing(fitted, TextureResidual(nothing, fitted.model))


def test_smoothing_within_a_region_keeps_a_constant_and_reads_nothing_outside() -> None:
    region = np.zeros((40, 40), bool)
    region[10:30, 5:35] = True
    values = np.where(region, 0.7, 100.0).astype(np.float32)
    np.testing.assert_allclose(smooth_within(values, region, 3.0)[region], 0.7, atol=1e-5)
    colors = np.repeat(values[..., None], 3, axis=2) * np.array([1.0, 2.0, 3.0], np.float32)
    smoothed = smooth_within(colors, region, 3.0)[region]
    np.testing.assert_allclose(smoothed, np.tile([0.7, 1.4, 2.1], (len(smoothed), 1)), atol=1e-5)
