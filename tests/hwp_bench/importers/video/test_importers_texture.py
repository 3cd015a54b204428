"""The texture's term. Oracle: a painted hand whose pose in every frame is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from painted_clip import (
    FRAMES,
    HAND,
    SETTINGS,
    assert_says_nothing,
    assert_slopes_lead_down,
    fit_to_errors,
    footage,
    pictures,
    pixel_error,
    true_pixels,
)

from hwp_bench.importers.video.model import frame_variables
from hwp_bench.importers.video.pictures import TextureEnergy
from hwp_bench.importers.video.residuals import ContourEnergy, signed_distance
from hwp_bench.importers.video.solve import FittedClip, fit_outline
from hwp_bench.importers.video.texture import SkinTexture, smooth_within


def texture_of(fitted: FittedClip) -> TextureEnergy:
    return TextureEnergy(pictures(), SETTINGS, fitted.model)


def test_a_painted_hand_comes_nearer_to_its_truth_than_by_its_outline() -> None:
    clip, windows, _, masks = footage()
    fields = np.stack([signed_distance(mask) for mask in masks])
    errors = []
    for painted in (False, True):
        fitted = fit_to_errors()
        contour = ContourEnergy(fields, clip.landmarks.detected, windows, SETTINGS, HAND)
        fit_outline(fitted, contour, texture=texture_of(fitted) if painted else None)
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
    clip, _, images, masks = footage()
    texture = SkinTexture(clip.template, 8.0)
    pixels = true_pixels()
    vertices = clip.vertices.astype(np.float32)
    views = [texture.view(*parts) for parts in zip(images, masks, vertices, pixels, strict=True)]
    for _ in range(2):
        for view, *hand in zip(views, vertices, pixels, strict=True):
            texture.add(*texture.seen(view, *hand))
        texture.finish()
    for view in views[::6]:
        expected, core = texture.expected(view)
        assert core.sum() > 0.3 * view.region.sum()
        assert np.corrcoef(expected[core], view.detail[core])[0, 1] > 0.9


def test_a_frame_without_a_hand_has_no_energy() -> None:
    fitted = fit_to_errors()
    nothing = replace(pictures(), masks=np.zeros_like(pictures().masks))
    assert_says_nothing(fitted, TextureEnergy(nothing, SETTINGS, fitted.model))


def test_smoothing_within_a_region_keeps_a_constant_and_reads_nothing_outside() -> None:
    region = np.zeros((40, 40), bool)
    region[10:30, 5:35] = True
    values = np.where(region, 0.7, 100.0).astype(np.float32)
    np.testing.assert_allclose(smooth_within(values, region, 3.0)[region], 0.7, atol=1e-5)
    colors = np.repeat(values[..., None], 3, axis=2) * np.array([1.0, 2.0, 3.0], np.float32)
    smoothed = smooth_within(colors, region, 3.0)[region]
    np.testing.assert_allclose(smoothed, np.tile([0.7, 1.4, 2.1], (len(smoothed), 1)), atol=1e-5)
