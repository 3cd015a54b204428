"""Colours that hands take from each other. Oracle: the mixture by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from odd_fits import a_light, part
from tiny_fits import UNJUDGED

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.methods.contract import TrainingCapture
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.evidence import ColorChanges
from wildghand.fitting.colors import OtherHand, clearly_visible, known_normals
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.gaussians.attributes import CHANNELS, SIZES
from wildghand.model.settings import read_settings

PLAIN: dict[str, Any] = {**UNJUDGED, "shadows.enabled": False, "start_colors": False}
# Channels of the colours in the attributes and in the map.
COLORS = slice(CHANNELS - SIZES["logit_colors"], CHANNELS)
TrainingMaker = Callable[..., TrainingCapture]


@pytest.fixture
def fit(make_training: TrainingMaker) -> Fit:
    made = make_fit(make_training("both"), read_settings(PLAIN), 0, torch.device("cpu"))
    with torch.no_grad():  # the hands start alike
        made.model.network.identity.maps["left"][:, COLORS] += 0.5
    made.model.keep(a_light())
    return made


def sharing(fit: Fit, left: float, right: float) -> ColorChanges | None:
    """What is taken if so much of each hand's colours is its own."""
    counts = {side: len(rig) for side, rig in fit.model.rigs.items()}
    own = {"left": left, "right": right}
    given = {side: np.full(counts[side], own[side]) for side in counts}
    other = part(fit, OtherHand)
    other.own = other.lent = given
    return other.learn(fit)


@torch.no_grad()
def level(fit: Fit, side: str, change: torch.Tensor | float) -> np.ndarray:
    """Log linear light of the mean colours over the known normals, with a change of the logits."""
    normals = known_normals(a_light())
    poses = fit.clip.parameters[side][0]
    rows = torch.linspace(0, len(poses) - 1, len(normals)).long()
    spread = normals[:, None].expand(-1, len(fit.model.rigs[side]), 3)
    made = fit.model.network(side, spread.contiguous(), poses[rows], None)
    logits = torch.logit(made.raw.logit_colors.sigmoid() * made.shadow).mean(dim=0) + change
    return np.log(srgb_to_linear(logits.sigmoid().double().numpy()))


def test_a_hand_that_nothing_shows_takes_the_others_colours(fit: Fit) -> None:
    found = sharing(fit, 0.0, 1.0)
    assert found is not None
    assert not np.allclose(level(fit, "left", 0.0), level(fit, "right", 0.0), atol=0.1)
    after = level(fit, "left", found.changes["left"])
    np.testing.assert_allclose(after, level(fit, "right", 0.0), atol=2e-3)
    np.testing.assert_allclose(found.changes["right"], 0.0, atol=1e-4)


@pytest.mark.parametrize(("left", "right"), [(0.3, 0.8), (1.0, 1.0), (0.0, 0.0)])
def test_the_mixture_is_by_what_each_knows(fit: Fit, left: float, right: float) -> None:
    found = sharing(fit, left, right)
    assert found is not None
    before = {side: level(fit, side, 0.0) for side in ("left", "right")}
    share = (1.0 - left) * right
    expected = (1.0 - share) * before["left"] + share * before["right"]
    np.testing.assert_allclose(level(fit, "left", found.changes["left"]), expected, atol=2e-3)


def test_frames_that_show_a_hand_clearly_make_its_colours_its_own(fit: Fit) -> None:
    assert set(part(fit, OtherHand).own) == {"left", "right"}
    for own in part(fit, OtherHand).own.values():
        assert own.min() == 0.0  # the backs that no frame shows
        assert own.max() > 0.9
    for side, lent in part(fit, OtherHand).lent.items():
        # Four times as easily: odds of n / half.
        own = part(fit, OtherHand).own[side]
        np.testing.assert_allclose(lent, 4.0 * own / (1.0 + 3.0 * own), atol=1e-6)


def test_unsure_frames_say_nothing_of_colours(fit: Fit) -> None:
    rows = torch.arange(len(fit.data.frames))
    fit.data.judgement.frame_weights[:] = 0.35
    assert not clearly_visible(fit.data, rows).any()
    fit.data.judgement.frame_weights[:] = 1.0
    torch.testing.assert_close(clearly_visible(fit.data, rows), fit.data.visible(rows))


def test_known_normals_lie_in_the_cap() -> None:
    normals = known_normals(a_light(0.5)).double().numpy()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(
        normals[:, 2], [-1.0] + 4 * [-math.cos(0.6 * math.pi / 3)], atol=1e-6
    )


def test_nothing_is_taken_without_a_light_or_another_hand(
    fit: Fit, make_training: TrainingMaker
) -> None:
    fit.model.light = None
    assert sharing(fit, 0.0, 1.0) is None
    one = make_fit(make_training(), read_settings(PLAIN), 0, torch.device("cpu"))
    one.model.keep(a_light())
    assert part(one, OtherHand).own == {}
    assert part(one, OtherHand).learn(one) is None
    off = read_settings({**PLAIN, "evidence.color_share": 0.0})
    assert make_fit(make_training("both"), off, 0, torch.device("cpu")).part(OtherHand) is None


def test_an_avatar_keeps_them(fit: Fit, tmp_path: Path) -> None:
    frame = int(fit.data.training.validation[0])
    where = fit.data.training.hand_poses(frame), fit.data.training.camera(frame)
    before = fit.avatar(0).render(*where)
    found = sharing(fit, 0.0, 1.0)
    assert found is not None
    fit.model.keep(found)
    drawn = fit.avatar(0).render(*where)
    assert np.abs(drawn - before).max() > 0.05
    again = load_avatar(save_avatar(fit.avatar(0), tmp_path / "avatar"))
    np.testing.assert_array_equal(again.render(*where), drawn)
