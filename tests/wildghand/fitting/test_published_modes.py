"""The modes `paper` and `released` in a fit.

Oracles: Eq. 7 and 8 and the authors' loss added up by hand (1e-5), the numbers of epochs and
frames, torch's own optimizer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from odd_fits import odd_fit, part
from painted import SilentReport, TrainingMaker
from tiny_fits import TINY

from hwp_bench.capture import HandModelId
from hwp_bench.hands import pose_hand, project
from hwp_bench.methods.contract import Budget, TrainingCapture
from wildghand.fitting.disentangle import Dpd
from wildghand.fitting.fit import Component, Fit, StepBatch
from wildghand.fitting.method import affordable
from wildghand.fitting.objective import Reconstruction, Regularisers, choose_perceptual
from wildghand.fitting.start import StartFromPrior
from wildghand.fitting.weights import Pao
from wildghand.gaussians.fit_loop import Loss
from wildghand.gaussians.regularizers import surface_laplacian
from wildghand.model import terms
from wildghand.model.frames import HandState
from wildghand.model.model import dimmed
from wildghand.model.settings import read_settings
from wildghand.plain import loop

ROWS = torch.tensor([0, 3])


def fit_of(training: TrainingCapture, mode: str, **changes: Any) -> Fit:
    """A fit before its first step, whose biases are large enough to tell them apart."""
    fit = odd_fit(training, {**TINY, "mode": mode, **changes})
    for module in fit.model.biases:
        torch.nn.init.normal_(module.psi.weight, std=0.02)
    return fit


def filled(training: TrainingCapture, frame: int) -> np.ndarray:
    """(H, W) bool: the faces of the posed right hand, each filled by OpenCV."""
    template, hand = training.template("right"), training.hands["right"]

    def one(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=torch.float32)[None]

    vertices = pose_hand(
        template.to_torch(),
        one(hand.pose[frame]),
        one(hand.betas)[0],
        one(hand.transl[frame]),
    ).vertices
    cameras = training.cameras
    places, _ = project(vertices, one(cameras.viewmats[frame]), one(cameras.Ks[frame]))
    # OpenCV also fills what a border touches: little at eight times the size.
    drawn = np.zeros((8 * training.height, 8 * training.width), np.uint8)
    for corners in np.rint(8 * places[0].numpy() - 0.5).astype(np.int32)[template.faces]:
        cv2.fillConvexPoly(drawn, corners, 1)
    return drawn[4::8, 4::8] > 0


def mean(values: torch.Tensor) -> float:
    return float(values.double().mean())


@pytest.mark.parametrize("mode", ["paper", "released"])
def test_the_loss_is_the_sum_of_its_terms(mode: str, make_training: TrainingMaker) -> None:
    fit = fit_of(make_training("both"), mode)
    batch, released = StepBatch(ROWS), mode == "released"
    with torch.no_grad():
        drawing = fit.draw(batch)
        target = fit.compare(batch, drawing)
        weights, image = target.weights, drawing.image
        visible = fit.data.masks(ROWS) > 0.5
        whole = fit.data.frames.images[ROWS] / 255.0
        aim = whole * (visible if released else fit.data.masks(ROWS))[..., None]
        perceptual = choose_perceptual(fit.settings, fit.device)
        assert perceptual is not None
        silhouette = fit.data.silhouettes(ROWS).float()
        expected: dict[type[Component], dict[str, float]] = {
            Reconstruction: {
                "L1": 100.0 * mean(weights[..., None] * (image - aim).abs()),
                "perceptual": 0.1 * float(perceptual(image, aim, weights)),
            },
            Pao: {"weights": -0.5 * mean(weights)},
            Regularisers: {},
        }
        if released:
            expected[Reconstruction]["silhouette"] = mean(
                (drawing.coverage[..., 0] - silhouette).square()
            )
        for side, hand in drawing.hands.items():
            raw, module = hand.prediction.raw, fit.model.biases_of(side)
            temporal = module.temporal(ROWS)
            biases = module.biases(raw, temporal.z, temporal.omega).concatenate()
            size = mean(biases.abs().sum(dim=-1))
            if released:
                size = mean(module.sum_of_means(raw.concatenate(), temporal.z).square())
            power = 2.0 if released else 1.0
            terms = {
                "bias": 0.1 * size,
                "shadow": 1e-3 * mean((1.0 - hand.prediction.shadow) ** power),
                "opacity": 0.1 * mean((1.0 - hand.opacities) ** power),
            }
            if released:
                smooth = surface_laplacian(fit.model.rigs[side])
                for name, values in (
                    ("scales", raw.log_scales),
                    ("colors", raw.logit_colors.sigmoid()),
                ):
                    terms[name] = 0.1 * float(smooth.roughness(values))
            expected[Regularisers] |= {f"{name} {side}": value for name, value in terms.items()}
        total = float(fit.loss(batch))
        for kind, sums in expected.items():
            found = sum(float(t) for t in part(fit, kind).loss(fit, batch, drawing, target))
            assert found == pytest.approx(sum(sums.values()), rel=1e-5), sums
            # No term could be left out unseen.
            assert min(map(abs, sums.values())) > 1e-4 * abs(found), sums
    assert total == pytest.approx(sum(sum(s.values()) for s in expected.values()), rel=1e-5)


def test_shading_and_cast_shadows_are_not_the_coefficient_s(make_training: TrainingMaker) -> None:
    fit, batch = fit_of(make_training("both"), "paper"), StepBatch(ROWS)
    with torch.no_grad():
        drawing = fit.draw(batch)
        target, regularisers = fit.compare(batch, drawing), part(fit, Regularisers)
        dark = torch.full(drawing.hands["right"].prediction.shadow.shape[:2], 0.3)
        shaded = replace(
            drawing,
            hands={
                side: replace(hand, prediction=dimmed(hand.prediction, dark))
                for side, hand in drawing.hands.items()
            },
        )
        before, after = (
            [float(term) for term in regularisers.loss(fit, batch, one, target)]
            for one in (drawing, shaded)
        )
    assert before == after


def test_in_paper_a_frame_whose_omega_is_dropped_has_no_temporal_factor(
    make_training: TrainingMaker,
) -> None:
    # Oracle: lambda_u of omega = 0 in the frame that is dropped, 1 / (1 + beta |omega|) of it else.
    # Thresholds of the background are below every error, so that W has lambda_u alone.
    fit = fit_of(make_training(), "paper")
    part(fit, Pao).weights.T_b.data.fill_(-1.0)
    part(fit, Dpd).drop = (torch.arange(len(fit.data.frames)) == 3).float()
    batch = StepBatch(ROWS)
    omega = fit.model.biases[0].temporal(ROWS).omega.detach()
    assert omega.abs().min() > 1e-4
    drawing = fit.draw(batch)
    kept = fit.draw(replace(batch, stepping=True))
    for drawn, left in ((drawing, [True, True]), (kept, [True, False])):
        expected = omega * torch.tensor(left)
        torch.testing.assert_close(drawn.omega.detach(), expected, rtol=0, atol=0)
        found = fit.compare(batch, replace(drawing, hands=drawn.hands)).weights
        factor = 1.0 / (1.0 + 1000.0 * expected.abs())
        plain = fit.compare(batch, replace(drawing, hands=_without_omega(drawn.hands))).weights
        torch.testing.assert_close(found, plain * factor[:, None, None], rtol=1e-5, atol=1e-6)


def test_a_frame_drops_the_omegas_of_both_hands(make_training: TrainingMaker) -> None:
    fit = fit_of(make_training("both"), "paper")
    dpd = part(fit, Dpd)
    dpd.drop.fill_(0.5)
    batch = StepBatch(torch.arange(len(dpd.drop)), stepping=True)
    kept = dpd.draws(fit, batch)["kept"]
    assert set(kept) == {"left", "right"}
    assert torch.equal(kept["left"], kept["right"])
    assert 0 < int(kept["left"].sum()) < len(dpd.drop)


def _without_omega(hands: Mapping[str, HandState]) -> dict[str, HandState]:
    return {side: replace(hand, omega=0.0 * hand.omega) for side, hand in hands.items()}


@pytest.mark.parametrize("mode", ["paper", "released"])
def test_the_terms_without_frames_are_the_template_and_the_texture(
    mode: str, make_training: TrainingMaker
) -> None:
    fit = fit_of(make_training("both"), mode)
    with torch.no_grad():
        features = {side: fit.model.network.features(side) for side in fit.model.rigs}
        found = fit._loss_of_features(features)
        apart = features["left"].texture - features["right"].texture
        texture = apart.abs() if mode == "paper" else apart.square()
        rough = [
            float(surface_laplacian(fit.model.rigs[side]).offsets(hand.template_offsets))
            for side, hand in features.items()
        ]
    assert found is not None
    assert min(rough) > 1e-6
    assert float(found) == pytest.approx(0.1 * (sum(rough) + mean(texture)), rel=1e-5)


def test_released_compares_with_the_frame_in_front_of_black_and_with_the_posed_mesh(
    make_training: TrainingMaker,
) -> None:
    training = make_training()
    fit = fit_of(training, "released")
    # Something covers a part of the hand.
    masks = fit.data.frames.masks.clone()
    masks[:, :, masks.shape[2] // 2 :] = 0
    fit.data.replace_masks(masks)
    part(fit, Pao).weights.T_b.data.fill_(50.0)
    drawing = fit.draw(StepBatch(ROWS))
    target = fit.compare(StepBatch(ROWS), drawing)
    silhouettes = fit.data.silhouettes(ROWS).numpy()
    posed = np.stack([filled(training, fit.data.frames.indices[row]) for row in ROWS])
    assert posed.sum() > 500
    assert (silhouettes != posed).sum() < 0.03 * posed.sum()  # a tenth of a pixel of border
    covered = silhouettes & (masks[ROWS].numpy() < 128)
    drawn = drawing.coverage[..., 0].detach().numpy() >= 0.95
    assert (covered & drawn).sum() > 50
    assert (target.weights.detach().numpy()[covered & drawn] == 0.0).all()
    assert (target.image.numpy()[masks[ROWS].numpy() < 128] == 0.0).all()
    # One number a frame where nothing is drawn.
    outside = (masks[ROWS].numpy() < 128) & ~drawn
    for weights, place in zip(target.weights.detach().numpy(), outside, strict=True):
        assert np.ptp(weights[place]) == 0.0
        assert 0.0 < weights[place][0] < 50.0


@pytest.mark.parametrize(
    ("mode", "hands", "batch"),
    [("paper", "both", 4), ("released", "right", 1), ("released", "both", 2)],
)
def test_a_fit_looks_fifty_times_at_every_frame(
    mode: str, hands: str, batch: int, make_training: TrainingMaker
) -> None:
    training = make_training(hands)
    fit = fit_of(training, mode)
    frames = len(fit.data.frames)
    assert len(next(fit.batches())) == batch
    assert fit.count_steps(Budget()) == fit.count_steps(Budget(seconds=5.0)) == 50 * frames / batch
    assert fit.count_steps(Budget(steps=7)) == 7
    # A budget in seconds leaves no frame out.
    assert affordable(training, fit.settings, Budget(seconds=1.0)) is training


@pytest.mark.parametrize("mode", ["paper", "released"])
def test_adam_is_torchs_with_its_own_constants(mode: str, make_training: TrainingMaker) -> None:
    fit = fit_of(make_training(), mode)
    optimizer = fit.descent.optimizer
    assert (optimizer.defaults["betas"], optimizer.defaults["eps"]) == ((0.9, 0.999), 1e-8)
    rates = {len(g["params"]): g["start"] for g in optimizer.param_groups}
    assert set(rates.values()) <= {1e-4, 1e-6, 0.01, 5e-4, 5e-5}
    thresholds = next(g for g in optimizer.param_groups if g["start"] == 1e-6)
    assert len(thresholds["params"]) == 3
    # All of them are clipped together, as by `clip_grad_norm_(model.parameters(), 1.0)`.
    assert all(group["clipped"] for group in optimizer.param_groups)
    theirs = [p.detach().clone().requires_grad_() for p in fit.descent.tensors()]
    fit.step(next(fit.batches()), 0.0)
    given = [p for p in zip(fit.descent.tensors(), theirs, strict=True) if p[0].grad is not None]
    for mine, other in given:
        other.grad = mine.grad.clone() if mine.grad is not None else None
    torch.nn.utils.clip_grad_norm_([other for _, other in given], 1.0)
    for group in optimizer.param_groups:
        pairs = [other for mine, other in given if any(mine is p for p in group["params"])]
        if pairs:
            torch.optim.Adam(pairs, lr=group["start"]).step()
    assert max(float((a - b).detach().abs().max()) for a, b in given) < 1e-7


def test_a_fit_whose_loss_falls_below_zero_goes_on(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: without the reward the loss is what it was. Windows of four steps; the reward of
    # weights is raised after the first, so that the second one's mean loss is below 0.
    monkeypatch.setattr(loop, "WINDOW", 4)
    fit = fit_of(make_training(), "paper")
    kept = dict(terms.WEIGHTS)
    losses: list[float] = []

    def raise_reward(step: int, watchers: loop.Watchers, told: Loss) -> None:
        losses.append(float(fit.loss(StepBatch(ROWS)).detach()))
        assert float(told) > 0.0
        if step == 4:
            raised = replace(kept["paper"], weight_reward=1e4)
            monkeypatch.setattr(terms, "WEIGHTS", {**kept, "paper": raised})

    avatar = loop.run_fit(fit, Budget(steps=12), SilentReport(), after_step=raise_reward)
    assert min(losses[:4]) > 0.0 > max(losses[4:])
    assert avatar.record.steps == 12


@pytest.mark.parametrize(
    ("mode", "moves"), [("released", True), ("paper", False), ("default", False)]
)
def test_a_gradient_that_is_not_finite_counts_as_zero_in_released_and_skips_a_step_elsewhere(
    mode: str, moves: bool, make_training: TrainingMaker
) -> None:
    plain = {"prepass.enabled": False, "subject.enabled": False, "shadows.enabled": False}
    fit = fit_of(make_training(), mode, **plain, **{"schedule.texture_every": 1})
    spoiled = fit.model.biases[0].phi[2].weight
    spoiled.register_hook(lambda gradient: torch.full_like(gradient, float("nan")))
    before = [p.detach().clone() for p in fit.descent.tensors()]
    place = next(i for i, p in enumerate(fit.descent.tensors()) if p is spoiled)
    fit.step(next(fit.batches()), 0.0)
    moved = [not torch.equal(a, b) for a, b in zip(fit.descent.tensors(), before, strict=True)]
    assert not moved[place]
    assert any(moved) == moves
    assert fit.finite()


def test_a_fit_of_the_papers_network_says_that_it_starts_from_random_weights() -> None:
    for size, expected in (("paper", 1), ("compact", 0)):
        said: list[str] = []
        fit = SimpleNamespace(
            settings=read_settings({"network.size": size}),
            data=SimpleNamespace(training=SimpleNamespace(hand_model=HandModelId("x", "0" * 64))),
            model=SimpleNamespace(network=None),
            tell=said.append,
        )
        StartFromPrior().before(fit)  # type: ignore[arg-type]
        assert len(said) == expected
        assert all("random weights" in text for text in said)
