"""Who weighs what. Oracles: the formulas by hand, the pre-pass's own arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from odd_fits import part
from painted import TrainingMaker
from tiny_fits import TINY

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.components import make_fit
from wildghand.fitting.data import FitData
from wildghand.fitting.disentangle import Dpd
from wildghand.fitting.fit import Fit, StepBatch
from wildghand.fitting.judging import Prepass
from wildghand.fitting.weights import Pao
from wildghand.gaussians.training import TrainingFrames
from wildghand.model.settings import read_settings
from wildghand.pao.pao import PaoSettings
from wildghand.prepass import PrepassInput, judge_frames

CPU = torch.device("cpu")
ROWS = torch.tensor([0, 3])


@pytest.fixture
def _strict(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the pre-pass leads PAO to spare is off."""
    monkeypatch.setattr(PaoSettings, "mismatch", 0.0)
    monkeypatch.setattr(PaoSettings, "spare_clean", False)


def fit_of(training: TrainingCapture, **changes: Any) -> Fit:
    """A fit before its first step; shadows take part in no weight, and their time is saved."""
    settings = read_settings({**TINY, "shadows.enabled": False, **changes})
    return make_fit(training, settings, 0, CPU)


@pytest.mark.usefixtures("_strict")
def test_frames_teach_by_their_temporal_weights(make_training: TrainingMaker) -> None:
    fit = fit_of(make_training())
    omega = torch.tensor([0.0, -0.2])
    shares = part(fit, Pao).shares(omega)
    np.testing.assert_allclose(shares, [1.0, 1.0 / (1.0 + 100.0 * 0.2)], rtol=1e-6)


def test_a_mismatch_that_all_frames_share_lifts_what_they_teach(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: the formula on the best tenth of the misplacements, by hand. A bent template would
    # meet the masks of this clip.
    training = make_training()
    monkeypatch.setattr(PaoSettings, "mismatch", 0.5)
    fit = fit_of(training, **{"subject.enabled": False})
    assessment = part(fit, Prepass).assessment
    found = np.quantile(assessment.misplacement[assessment.usable], 0.1)
    shared = 0.5 * found / fit.settings.prepass.misplacement_floor
    tolerance = shared**2 / (1.0 + shared**2)
    assert 0.0 < tolerance < 1.0
    shares = part(fit, Pao).shares(torch.tensor([0.0, -0.2]))
    alone = 1.0 / (1.0 + 100.0 * 0.2)
    np.testing.assert_allclose(shares, [1.0, alone + tolerance * (1.0 - alone)], rtol=1e-6)
    # Regions that are rejected keep that share of the hand's weight.
    drawing = fit.draw(StepBatch(ROWS))
    lifted = fit.compare(StepBatch(ROWS), drawing).weights
    monkeypatch.setattr(PaoSettings, "mismatch", 0.0)
    without = fit_of(training, **{"subject.enabled": False})
    strict = without.compare(StepBatch(ROWS), drawing).weights
    assert (lifted >= strict - 1e-6).all()
    assert lifted.sum() > strict.sum()
    monkeypatch.undo()
    # Without the pre-pass nothing is known of it.
    assert part(fit_of(training, **{"prepass.enabled": False}), Pao).tolerance == 0.0


@pytest.mark.parametrize(
    "changes",
    [
        {"dpd.enabled": False},
        {"pao.enabled": False},
        {"pao.variant": "binary"},
        {"mode": "paper"},
        {"mode": "released"},
    ],
    ids=str,
)
def test_all_frames_teach_alike_where_a_part_of_it_is_missing(
    changes: dict[str, Any], make_training: TrainingMaker
) -> None:
    fit = fit_of(make_training(), **changes)
    found = fit.part(Pao)
    assert found is None or "teach" not in found.draws(fit, StepBatch(ROWS))


@pytest.mark.usefixtures("_strict")
@pytest.mark.parametrize("pao", [True, False])
def test_the_prepass_lowers_covered_pixels_with_pao_and_without(
    pao: bool, make_training: TrainingMaker
) -> None:
    training = make_training()
    fit, bare = (
        fit_of(training, **{"pao.enabled": pao, "prepass.enabled": on}) for on in (True, False)
    )
    assessment = part(fit, Prepass).assessment
    drawing = fit.draw(StepBatch(ROWS))
    weights, whole = (
        fit.compare(StepBatch(ROWS), drawing).weights,
        bare.compare(StepBatch(ROWS), drawing).weights,
    )
    expected = whole * torch.from_numpy(assessment.pixel_weights[ROWS.numpy()]).float() / 255.0
    torch.testing.assert_close(weights.detach(), expected.detach(), rtol=1e-5, atol=1e-6)


def test_validation_frames_are_known_to_be_clean(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: the pre-pass with the validation frames and without; a clip that tolerates nothing.
    training = make_training()
    believing = fit_of(training, **{"prepass.tolerance": 1e-3})
    monkeypatch.setattr(FitData, "judges", None)
    alone = fit_of(training, **{"prepass.tolerance": 1e-3})
    monkeypatch.undo()
    judges = believing.data.judges
    assert judges is not None
    assert set(judges.indices.tolist()) <= set(training.validation.tolist())

    def given(frames: TrainingFrames) -> PrepassInput:
        images, masks = np.asarray(frames.images), np.asarray(frames.masks)
        bent = believing.data.bent
        return PrepassInput(frames.indices, images, masks, training.hands, training.cameras, bent)

    for fit, known in ((believing, given(judges)), (alone, None)):
        expected = judge_frames(given(fit.data.frames), believing.settings.prepass, known)
        np.testing.assert_array_equal(fit.data.judgement.clean, np.float32(expected.clean))
    assert not torch.equal(believing.data.judgement.clean, alone.data.judgement.clean)
    # They teach nothing: a fit has the rows of its training frames alone.
    assert believing.data.frames.indices.tolist() == alone.data.frames.indices.tolist()


def test_regions_of_clean_frames_are_lifted_by_how_clean_they_are(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: w + c (1 - w) on the weights of regions, from those of the fit that spares nothing.
    training = make_training()
    monkeypatch.setattr(PaoSettings, "mismatch", 0.0)
    spares = fit_of(training)
    monkeypatch.setattr(PaoSettings, "spare_clean", False)
    strict = fit_of(training)
    clean = spares.data.judgement.clean[ROWS]
    assert (clean > 0.0).all()
    drawing = spares.draw(StepBatch(ROWS))
    found = spares.compare(StepBatch(ROWS), drawing)
    lower = strict.compare(StepBatch(ROWS), drawing).weights
    outside = spares.settings.terms.outside_weight * (1.0 - found.hand)
    pixels = spares.data.uncovered(ROWS)
    regions = lower - outside * pixels
    expected = lower + clean[:, None, None] * (found.hand * pixels - regions)
    torch.testing.assert_close(found.weights, expected, rtol=1e-5, atol=1e-6)


def test_regions_that_are_drawn_badly_count_less(make_training: TrainingMaker) -> None:
    fit = fit_of(make_training(), **{"prepass.enabled": False})
    row = torch.tensor([0])
    drawing = fit.draw(StepBatch(row))
    target = fit.compare(StepBatch(row), drawing)
    hand = fit.compare(StepBatch(row), drawing).hand[0] > 0.9
    error = (drawing.image[0].detach() - target.image[0]).abs().mean(dim=-1)
    worst, best = (error >= error[hand].quantile(0.9)), (error <= error[hand].quantile(0.1))
    weights = target.weights[0].detach()
    assert weights[hand & worst].mean() < 0.8 * weights[hand & best].mean()
    assert part(fit, Pao).median is not None


def test_a_fit_that_goes_back_weighs_as_if_it_had_not_gone_on(make_training: TrainingMaker) -> None:
    # Oracle: a fit that takes no step.
    training = make_training()
    fit, other = fit_of(training), fit_of(training)
    start, before = fit.snapshot(), other._weight_masks()
    for step in range(3):
        fit.step(torch.tensor([step]), 0.0)
    thresholds = part(fit, Pao).weights
    assert thresholds.T_E.item() != thresholds.constants.error_threshold
    fit.restore(start)
    assert thresholds.T_E.item() == thresholds.constants.error_threshold
    after = fit._weight_masks()
    assert any(mask.any() and mask.min() < 255 for mask in after.values())
    for frame, mask in before.items():
        np.testing.assert_array_equal(after[frame], mask)


def test_omega_starts_where_the_prepass_weight_puts_it(make_training: TrainingMaker) -> None:
    fit = fit_of(make_training())
    rows = torch.arange(len(fit.data.frames))
    omega = fit.model.biases[0].temporal(rows).omega.detach()
    temporal = part(fit, Dpd).temporal
    assert temporal is not None
    target = temporal.omega
    assert float((omega - target).abs().mean()) < 0.05
    # docs/dpd_pao.md: 1 in a clean frame, 0.02 in a perturbed one.
    expected = 1.0 / (1.0 + 12.5 * (1.0 / fit.data.judgement.frame_weights - 1.0))
    factor = part(fit, Pao).weights.temporal_factor(target)
    torch.testing.assert_close(factor, expected, rtol=1e-4, atol=1e-4)
    assert 0.0196 - 1e-4 <= float(factor.min()) < float(factor.max()) <= 1.0


def test_only_poses_that_disagree_with_their_mask_are_refined_in_a_batch_of_both(
    make_training: TrainingMaker,
) -> None:
    fit = fit_of(make_training(), **{"schedule.batch": 2})
    judged = part(fit, Prepass)
    judged._refine_pose = torch.zeros(len(fit.data.frames), dtype=torch.bool)
    judged._refine_pose[3] = True
    for step in range(3):
        fit.step(ROWS, step / 3)
    for steps in (fit.model.pose_steps, fit.model.transl_steps):
        moved = steps.detach().abs().amax(dim=(0, *range(2, steps.ndim)))
        assert moved.nonzero().flatten().tolist() == [3]


@pytest.mark.parametrize("judged", [True, False])
def test_an_avatar_says_which_frames_are_clean_where_they_were_judged(
    judged: bool, make_training: TrainingMaker
) -> None:
    fit = fit_of(make_training(), **{"prepass.enabled": judged})
    record = fit.avatar(0).record
    found = fit.data.judgement
    assert record.clean == (found.clean.tolist() if judged else [])
    assert record.frame_weights == (found.frame_weights.tolist() if judged else [])


def test_without_heads_the_template_stands_and_nothing_else_changes(
    make_training: TrainingMaker,
) -> None:
    training = make_training()
    fit, bare = fit_of(training), fit_of(training, **{"heads": False})
    for made in (fit, bare):
        with torch.no_grad():
            for value in made.model.network.template_head.parameters():
                value.fill_(0.05)
    row = torch.tensor([0])
    moved = fit.draw(StepBatch(row)).hands["right"].prediction.template_offsets
    still = bare.draw(StepBatch(row)).hands["right"].prediction.template_offsets
    assert moved.abs().max() > 0.0
    assert (still == 0.0).all()
    raw = (
        made.draw(StepBatch(row)).hands["right"].prediction.raw.concatenate()
        for made in (fit, bare)
    )
    assert torch.equal(*raw)
    bare.loss(StepBatch(row)).backward()
    assert all(
        value.grad is None or not value.grad.any()
        for value in bare.model.network.template_head.parameters()
    )
