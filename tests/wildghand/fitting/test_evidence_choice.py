"""The choice of the strengths of evidence and fill. Oracles: the avatar's own pictures as truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from odd_fits import a_light, odd_fit
from tiny_fits import UNJUDGED

from hwp_bench.capture.splits import Split
from hwp_bench.methods.contract import TrainingCapture
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.evidence import (
    ColorChanges,
    Evidence,
    EvidenceSettings,
    fill_shares,
    strengths,
    weigh_evidence,
)
from wildghand.fitting.evidence_choice import EvidenceChoice
from wildghand.fitting.fit import Fit
from wildghand.gaussians.training import load_validation_frames
from wildghand.subject.fit_subject import LEAST_CHOOSING

QUICK: dict[str, Any] = {**UNJUDGED, "light.enabled": False}
TrainingMaker = Callable[..., TrainingCapture]


def begun(training: TrainingCapture, **changes: Any) -> Fit:
    """A fit whose Gaussians stand off the skin, as chance wills."""
    return odd_fit(training, {**QUICK, **changes})


@pytest.fixture
def training(make_training: TrainingMaker) -> TrainingCapture:
    """Six of the painted frames are for validation."""
    made = make_training()
    first, last = made.split.test[[0, -1]].tolist()
    made.split = Split(made.id, last + 1, (0, first - 6), (first - 6, first), (first, last + 1))
    made._train = made.split.train
    return made


def drawn_with(fit: Fit, training: TrainingCapture, index: int) -> np.ndarray:
    """(F, H, W, 3) validation frames as the avatar draws them with one of the strengths."""
    chosen = strengths(fit.settings.evidence)[index]
    before = fit.model.evidence
    fit.model.evidence = weigh_evidence(fit.choice.shown, len(fit.frames), chosen)
    avatar = fit.avatar(0)
    images = [
        avatar.render(training.hand_poses(frame), training.camera(frame))[..., :3]
        for frame in training.validation.tolist()
    ]
    fit.model.evidence = before
    return np.clip(np.stack(images), 0.0, 1.0)


def error_with(
    choice: EvidenceChoice, evidence: Evidence | None, colors: ColorChanges | None
) -> float:
    """The error of all validation frames as they are drawn with both."""
    drawings = choice.drawings
    assert drawings is not None
    return drawings.error(drawings.predict_all(), evidence, colors)


def judged_by(choice: EvidenceChoice, images: torch.Tensor) -> EvidenceChoice:
    """The same choice, with (F, H, W, 3) uint8 images as the truth."""
    drawings = choice.drawings
    assert drawings is not None
    frames = dataclasses.replace(drawings.frames, images=images)
    return dataclasses.replace(choice, judges=dataclasses.replace(drawings, frames=frames))


def test_errors_are_those_of_the_avatars_pictures(training: TrainingCapture) -> None:
    fit = begun(training)
    assert fit.choice.drawings is not None
    frames = fit.choice.drawings.frames
    hand = frames.masks.numpy()[..., None] / 255.0
    truth = frames.images.numpy() / 255.0
    for index, settings in enumerate(strengths(fit.settings.evidence)):
        off = (drawn_with(fit, training, index) - truth) ** 2 * hand
        expected = off.sum() / hand.sum() / 3.0
        found = error_with(
            fit.choice, weigh_evidence(fit.choice.shown, len(fit.frames), settings), None
        )
        assert found == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("index", range(4))
def test_the_strength_that_draws_the_frames_best_is_chosen(
    index: int, training: TrainingCapture
) -> None:
    fit = begun(training)
    images = torch.from_numpy((255.0 * drawn_with(fit, training, index)).round().astype(np.uint8))
    choice = judged_by(fit.choice, images)
    found = choice.best()
    if index == 0:  # the model has it already
        assert found == []
        return
    (evidence,) = found
    assert isinstance(evidence, Evidence)
    chosen = strengths(fit.settings.evidence)[index]
    expected = weigh_evidence(fit.choice.shown, len(fit.frames), chosen).to_tensors()
    for name, shares in evidence.to_tensors().items():
        assert torch.equal(shares, expected[name])


def test_strengths_are_around_the_settings_own() -> None:
    own = EvidenceSettings(offset_share=0.2)
    shares = [(one.offset_share, one.shape_share) for one in strengths(own)]
    assert shares == [(0.2, 0.002), (0.05, 0.002), (0.8, 0.002), (0.0, 0.002)]


@pytest.mark.parametrize("index", range(3))
def test_the_fill_that_draws_the_frames_best_is_chosen(
    index: int, training: TrainingCapture
) -> None:
    fit = begun(training)
    fit.model.keep(a_light())
    # Hardly anything is shown, so that each share changes what the frames show.
    shown = {side: 0.05 * count for side, count in fit.choice.shown.items()}
    filled = dataclasses.replace(fit.choice.filled, shown=shown)
    choice = dataclasses.replace(fit.choice, filled=filled)
    fills = filled.carried_on(fill_shares(fit.settings.evidence))
    fit.model.color_changes = fills[index]
    images = torch.from_numpy((255.0 * drawn_with(fit, training, 0)).round().astype(np.uint8))
    fit.model.color_changes = None
    found = judged_by(choice, images).best()
    if index == 2:  # as they were learnt
        assert found == []
        return
    (colors,) = found
    expected = fills[index]
    assert isinstance(colors, ColorChanges)
    assert expected is not None
    assert torch.equal(colors.changes["right"], expected.changes["right"])


def test_fills_are_around_the_settings_own() -> None:
    assert fill_shares(EvidenceSettings(fill_share=0.04)) == [0.04, 0.2, 0.0]
    assert fill_shares(EvidenceSettings(fill_share=0.0)) == [0.0]


def test_looking_changes_nothing_and_finishing_keeps_the_best(
    training: TrainingCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = begun(training)
    before = {name: value.clone() for name, value in fit.model.state_dict().items()}
    assert fit.choice.seconds() > 0.0
    fit.choice.best()
    assert all(torch.equal(value, before[name]) for name, value in fit.model.state_dict().items())
    # Offsets as they were learnt are made to be the best.
    kept = weigh_evidence(fit.choice.shown, len(fit.frames), strengths(fit.settings.evidence)[3])
    monkeypatch.setattr(EvidenceChoice, "best", lambda choice: [kept])
    fit.finish()
    frame = int(training.validation[0])
    where = training.hand_poses(frame), training.camera(frame)
    drawn = fit.avatar(0).render(*where)
    fit.model.evidence = weigh_evidence(fit.choice.shown, len(fit.frames), fit.settings.evidence)
    assert np.abs(fit.avatar(0).render(*where) - drawn).max() > 0.01
    fit.model.evidence = kept
    np.testing.assert_allclose(fit.avatar(0).render(*where), drawn, atol=1e-6)
    again = load_avatar(save_avatar(fit.avatar(0), tmp_path / "avatar"))
    np.testing.assert_allclose(again.render(*where), drawn, atol=1e-6)


@pytest.mark.parametrize(
    "changes", [{"evidence.validated": False}, {"evidence.enabled": False}, {"mode": "paper"}]
)
def test_nothing_is_chosen_where_it_is_off(
    changes: dict[str, Any], training: TrainingCapture
) -> None:
    fit = begun(training, **changes)
    assert fit.choice.drawings is None
    assert fit.choice.best() == []
    assert fit.choice.seconds() == 0.0


def test_a_frame_or_two_do_not_judge(training: TrainingCapture) -> None:
    first, last = training.targets[[0, -1]].tolist()
    few = first - LEAST_CHOOSING + 1
    training.split = Split(training.id, last + 1, (0, few), (few, first), (first, last + 1))
    training._train = training.split.train
    assert begun(training).choice.drawings is None


def test_validation_frames_are_spread_and_never_fitted_ones(training: TrainingCapture) -> None:
    first, last = training.validation[[0, -1]].tolist()
    assert load_validation_frames(training, 2).indices.tolist() == [first, last]
    training._train = np.sort(np.append(training.train, first))
    assert first not in load_validation_frames(training, 100).indices
    hand = training.hands["right"]
    valid = hand.valid.copy()
    valid[last] = False
    training.hands = {"right": dataclasses.replace(hand, valid=valid)}
    assert last not in load_validation_frames(training, 100).indices
