"""How far Gaussians are trusted. Oracles: the formula, discs by hand, a sphere's two halves."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from painted import TrainingMaker
from tiny_fits import UNJUDGED

from hwp_bench.hands import load_template, pose_hand, project
from hwp_bench.hands.raster import draw_silhouette
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.avatar.studio import HandAngles
from wildghand.fitting.components import make_fit
from wildghand.gaussians.attributes import Activation, RawAttributes
from wildghand.gaussians.rig import make_rig
from wildghand.model.settings import read_settings
from wildghand.splat import rasterize
from wildghand.visibility import (
    ColorChanges,
    Visibility,
    VisibilitySettings,
    never_shown,
    shown_frames,
    weigh_visibility,
)
from wildghand.visibility.count import _FAR, _depth_image

SPACING = 2e-3


def raw_attributes(count: int = 40, seed: int = 0) -> RawAttributes:
    generator = torch.Generator().manual_seed(seed)
    return RawAttributes.split(torch.randn(2, count, 14, generator=generator))


def visibility(offsets: float, shapes: float, count: int = 40) -> Visibility:
    return Visibility(
        {"right": torch.full((count,), offsets)}, {"right": torch.full((count,), shapes)}
    )


def test_with_all_the_visibility_gaussians_are_drawn_as_they_were() -> None:
    raw, activation = raw_attributes(), Activation()
    settled = visibility(1.0, 1.0).settle("right", raw, SPACING, activation.log_scale_bias)
    before, after = activation(raw), activation(settled)
    for name in ("offsets", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name))
    turns = (before.quats * after.quats).sum(dim=-1).abs()
    torch.testing.assert_close(turns, torch.ones_like(turns))


def test_without_visibility_gaussians_are_opaque_discs_on_the_skin_in_their_colours() -> None:
    raw, activation = raw_attributes(), Activation()
    settled = visibility(0.0, 0.0).settle("right", raw, SPACING, activation.log_scale_bias)
    drawn = activation(settled)
    assert not drawn.offsets.any()
    disc = torch.tensor([0.9, 0.9, 0.2]) * SPACING
    torch.testing.assert_close(drawn.scales, disc.expand_as(drawn.scales))
    torch.testing.assert_close(drawn.quats[..., 0], torch.ones(2, 40))
    assert drawn.opacities.min() > 0.98
    torch.testing.assert_close(drawn.colors, activation(raw).colors)


@pytest.mark.parametrize("turn", [0.0, 180.0])
def test_discs_alone_cover_the_skin(turn: float) -> None:
    """Oracle: the outline of the posed mesh, 3 px inside of which nothing may shine through."""
    template, angles = load_template("anny", "right"), HandAngles.of("anny", "right")
    pose = torch.from_numpy(angles.pose(angles.from_names({"wrist twist": turn}))).float()[None]
    betas, transl = torch.zeros(10), torch.tensor([[0.0, 0.0, 0.6]])
    rig, activation = make_rig(template, 12_337), Activation()
    place = rig.pose(pose, betas, transl)
    settled = visibility(0.0, 0.0, len(rig)).settle(
        "right", raw_attributes(len(rig)), rig.spacing, activation.log_scale_bias
    )
    discs = activation(settled)
    # The camera looks along z at the middle of the hand.
    middle = place.positions[0].mean(dim=0)
    K = torch.tensor([[[600.0, 0.0, 128.0], [0.0, 600.0, 128.0], [0.0, 0.0, 1.0]]])
    K[0, :2, 2] -= 1000.0 * middle[:2]
    _, coverage, _ = rasterize(
        place.positions,
        place.orientations,
        discs.scales[:1],
        discs.opacities[:1],
        torch.ones(1, len(rig), 3),
        torch.eye(4)[None],
        K,
        256,
        256,
    )
    posed = pose_hand(template.to_torch(), pose, betas, transl).vertices
    pixels, _ = project(posed, torch.eye(4)[None], K)
    drawn = draw_silhouette(pixels[0].double().numpy(), template.faces, 256)
    inside = cv2.erode((drawn > 0).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert inside.sum() > 5_000
    assert coverage[0, ..., 0].numpy()[inside].min() > 0.95


def test_skin_that_no_frame_shows_is_as_learnt_from_behind_and_discs_from_the_front() -> None:
    raw, bias = raw_attributes(), Activation().log_scale_bias
    # A twentieth in front of the tangent plane is half of the way to where a frame counts.
    facing = torch.tensor([-0.5, 0.0, 0.05, 0.1, 0.9]).repeat(2, 8)
    none = visibility(0.0, 0.0)
    found = none.settle("right", raw, SPACING, bias, none.behind("right", facing)).concatenate()
    learnt = visibility(1.0, 1.0).settle("right", raw, SPACING, bias).concatenate()
    discs = none.settle("right", raw, SPACING, bias).concatenate()
    half = visibility(0.5, 0.5).settle("right", raw, SPACING, bias).concatenate()
    for expected, near in ((learnt, facing <= 0.0), (half, facing == 0.05), (discs, facing >= 0.1)):
        torch.testing.assert_close(found[near], expected[near])
    # Offsets may be kept as they were learnt everywhere: then no share of them is added.
    whole = visibility(1.0, 0.0)
    found = whole.settle("right", raw, SPACING, bias, whole.behind("right", facing)).concatenate()
    torch.testing.assert_close(found[facing <= 0.0], learnt[facing <= 0.0])
    # Elsewhere the camera has no say.
    some = visibility(0.3, 0.3)
    seen = some.settle("right", raw, SPACING, bias, some.behind("right", facing)).concatenate()
    assert torch.equal(seen, some.settle("right", raw, SPACING, bias).concatenate())


def test_unseen_skin_that_faces_away_keeps_the_colours_that_were_learnt() -> None:
    # They shine through the skin that frames show.
    raw, facing = raw_attributes(), torch.tensor([-0.5, 0.0, 0.05, 0.1, 0.9]).repeat(2, 8)
    behind = visibility(0.0, 0.0).behind("right", facing)
    expected = torch.tensor([1.0, 1.0, 0.5, 0.0, 0.0]).repeat(2, 8)
    torch.testing.assert_close(behind, expected)
    changes = ColorChanges({"right": torch.ones(40, 3)})
    colored = changes.color("right", raw, behind)
    torch.testing.assert_close(colored.concatenate()[..., 11:], colored.logit_colors)
    found = colored.logit_colors - raw.logit_colors
    torch.testing.assert_close(found, (1.0 - expected)[..., None].expand_as(found))
    assert not visibility(0.3, 0.3).behind("right", facing).any()


def test_a_single_place_is_not_shown_and_the_rim_of_what_is_shown_is_free() -> None:
    # Places in a row, each the neighbour of the two on either side.
    row = torch.arange(30)
    near = torch.stack([row - 2, row - 1, row + 1, row + 2], dim=1)
    near[(near < 0) | (near > 29)] = -1
    shown = torch.zeros(30)
    shown[:10] = 2.0
    shown[20] = 5.0
    # Skin is shown up to place 9, and two more places are free.
    assert never_shown(shown, near).nonzero()[:, 0].tolist() == list(range(12, 30))


def amounts(most: float) -> st.SearchStrategy[float]:
    """Nothing, or what float32 can tell from nothing."""
    return st.just(0.0) | st.floats(1e-6, most)


@given(
    shown=amounts(200.0),
    count=st.integers(1, 200),
    offset=amounts(10.0),
    shape=amounts(10.0),
)
def test_shares_are_those_of_the_formula(
    shown: float, count: int, offset: float, shape: float
) -> None:
    settings = VisibilitySettings(offset_share=offset)
    with mock.patch.object(VisibilitySettings, "shape_share", shape):
        found = weigh_visibility({"left": torch.tensor([shown])}, count, settings)
    for share, half in ((found.offsets, offset), (found.shapes, shape)):
        expected = np.float64(shown) / (shown + half * count) if half else 1.0
        expected = 0.0 if np.isnan(expected) else expected
        got = float(share["left"])
        assert 0.0 <= got <= 1.0
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_the_depth_image_has_the_nearest_of_all_hands_around_a_cell() -> None:
    one = (torch.tensor([[[10.0, 10.0]]]), torch.tensor([[0.5]]))
    other = (torch.tensor([[[11.0, 10.0], [-5.0, 3.0]]]), torch.tensor([[0.4, 0.1]]))
    image = _depth_image({"right": one, "left": other}, torch.Size((40, 60)))[0]
    assert float(image[10, 10]) == pytest.approx(0.4)
    assert float(image[10, 9]) == pytest.approx(0.5)
    assert float(image[20, 20]) == _FAR
    assert float(image.min()) == pytest.approx(0.4)


def test_frames_show_what_faces_them_and_lies_in_the_mask(make_training: TrainingMaker) -> None:
    """All of a frame counts as visible: about half of a hand faces a camera, and never all."""
    fit = make_fit(make_training(), read_settings(UNJUDGED), 0, torch.device("cpu"))
    rows, size = len(fit.data.frames), fit.data.frames.masks.shape[1:]
    everything = shown_frames(
        fit.model.rigs, fit.clip, lambda part: torch.ones(len(part), *size), rows
    )
    nothing = shown_frames(
        fit.model.rigs, fit.clip, lambda part: torch.zeros(len(part), *size), rows
    )
    half = shown_frames(
        fit.model.rigs, fit.clip, lambda part: torch.full((len(part), *size), 0.5), rows
    )
    for side, found in everything.items():
        assert 0.2 < float(found.mean()) / rows < 0.6
        assert float(found.max()) <= rows
        assert not nothing[side].any()
        torch.testing.assert_close(half[side], 0.5 * found)


def test_an_avatar_keeps_its_visibility(make_training: TrainingMaker, tmp_path: Path) -> None:
    training = make_training()
    fit = make_fit(training, read_settings(UNJUDGED), 0, torch.device("cpu"))
    bare = make_fit(
        training, read_settings({**UNJUDGED, "visibility.enabled": False}), 0, torch.device("cpu")
    )
    frame = int(training.validation[0])
    where = training.hand_poses(frame), training.camera(frame)
    drawn = fit.avatar(0).render(*where)
    assert not np.array_equal(drawn, bare.avatar(0).render(*where))
    again = load_avatar(save_avatar(fit.avatar(0), tmp_path / "avatar"))
    np.testing.assert_array_equal(again.render(*where), drawn)


def test_colours_alone_change() -> None:
    generator = torch.Generator().manual_seed(0)
    made = ColorChanges({"left": torch.randn(40, 3, generator=generator)})
    raw = RawAttributes.split(torch.zeros(2, 40, 14))
    changed = made.color("left", raw)
    for name, values in changed.items():
        expected = made.changes["left"] if name == "logit_colors" else torch.zeros(())
        torch.testing.assert_close(values, expected.expand_as(values))
