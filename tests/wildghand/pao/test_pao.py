"""PAO. Oracle: the paper's two equations evaluated mask by mask in numpy, float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import BadMethod, ShapeMismatch, UsageError
from hwp_bench.methods.settings import settings_from
from wildghand.pao.pao import (
    CONSTANTS,
    PAPER_PAO,
    PaoSettings,
    PerturbationAwareWeights,
    binary_weights,
)
from wildghand.pao.regions import FrameRegions, Regions, overlapping, partition, stack_regions

PRINTED = PAPER_PAO.variant
SIZE = 12


def scene(seed: int = 0, frames: int = 2) -> tuple[torch.Tensor, np.ndarray, torch.Tensor]:
    """Errors, overlapping masks (B, U, H, W) and hands."""
    random = np.random.default_rng(seed)
    error = random.uniform(0.0, 1.0, (frames, SIZE, SIZE))
    masks = random.uniform(size=(frames, 5, SIZE, SIZE)) < 0.6
    hand = random.uniform(size=(frames, SIZE, SIZE)) < 0.5
    return torch.from_numpy(error), masks, torch.from_numpy(hand)


def regions_of(masks: np.ndarray) -> Regions:
    return stack_regions([overlapping(frame) for frame in masks])


def module_of(variant: str, share_of: Any = "hand", **changes: float) -> PerturbationAwareWeights:
    """The weights with other thresholds, by their names."""
    made = PerturbationAwareWeights(variant, share_of=share_of)
    with torch.no_grad():
        for name, value in changes.items():
            getattr(made, name).fill_(value)
    return made


def printed(
    error: np.ndarray,
    masks: np.ndarray,
    hand: np.ndarray,
    omega: float,
    threshold: float,
    share_of: str,
) -> np.ndarray:
    """W of one frame, as the paper writes it, with |omega|; T_b is 1.2."""
    total = np.zeros_like(error)
    for mask in masks:
        both = mask & hand
        mu = both.sum() / (hand.sum() if share_of == "hand" else mask.sum())
        weight = 100.0 * max(threshold - error[both].mean(), 0.0)
        weight *= max(mu - 0.3, 0.0) / (1.0 + 1000.0 * abs(omega))
        total += weight * mask
    return total + ~hand * np.maximum(1.2 - 3.0 * error, 0.0)


@pytest.mark.parametrize("share_of", ["hand", "region"])
@pytest.mark.parametrize("threshold", [0.3, 0.55])
def test_weights_are_the_papers(share_of: str, threshold: float) -> None:
    error, masks, hand = scene()
    omega = torch.tensor([-0.3, 0.001], dtype=torch.float64)
    module = module_of(PRINTED, share_of, T_E=threshold, T_b=1.2).double()
    made = module(error, regions_of(masks), hand, omega)
    for frame in range(2):
        expected = printed(
            error[frame].numpy(),
            masks[frame],
            hand[frame].numpy(),
            float(omega[frame]),
            threshold,
            share_of,
        )
        # The thresholds were float32 for a moment.
        np.testing.assert_allclose(made.weights[frame].detach(), expected, atol=1e-5)


def test_a_partition_is_the_same_regions_as_its_masks() -> None:
    error, _, hand = scene()
    labels = np.arange(SIZE * SIZE).reshape(SIZE, SIZE) // 30
    masks = np.stack([labels == u for u in range(labels.max() + 1)])
    module = module_of(PRINTED, T_mu=0.05)
    omega = torch.zeros(2)
    apart = module(error, stack_regions([partition(labels)] * 2), hand, omega)
    general = module(error, regions_of(np.stack([masks] * 2)), hand, omega)
    torch.testing.assert_close(apart.lambdas, general.lambdas)
    torch.testing.assert_close(apart.weights, general.weights)


def test_only_the_thresholds_get_a_gradient_and_the_right_one() -> None:
    error, masks, hand = scene()
    error.requires_grad_(True)
    omega = torch.tensor([0.01, -0.02], dtype=torch.float64, requires_grad=True)
    regions = regions_of(masks)
    module = module_of(PRINTED, T_b=1.5).double()
    parameters = tuple(module.parameters())
    (module(error, regions, hand, omega).weights * error.detach()).mean().backward()
    assert error.grad is None
    assert omega.grad is None

    def loss(*thresholds: torch.Tensor) -> torch.Tensor:
        named = dict(zip(("T_E", "T_mu", "T_b"), thresholds, strict=True))
        made = torch.func.functional_call(module, named, (error, regions, hand, omega))
        return (made.weights * error.detach()).mean()

    assert all(value.grad is not None and value.grad.abs() > 0.0 for value in parameters)
    assert torch.autograd.gradcheck(loss, parameters, atol=1e-7)


def test_the_reward_of_weight_moves_the_thresholds_apart() -> None:
    error, masks, hand = scene()
    module = module_of(PRINTED, T_b=1.5)
    (-0.5 * module(error, regions_of(masks), hand, torch.zeros(2)).weights.mean()).backward()
    assert module.T_E.grad < 0.0 < module.T_mu.grad
    assert module.T_b.grad < 0.0


def test_binary_variant_is_the_hand() -> None:
    _, _, hand = scene()
    assert torch.equal(binary_weights(hand), hand.float())
    assert torch.equal(binary_weights(0.6 * hand), hand.float())


def test_two_hands_have_a_background_threshold_of_their_own() -> None:
    single, both = (PerturbationAwareWeights(hands=hands).T_b.item() for hands in (1, 2))
    assert (single, both) == (3.0, 10.0)


def test_superpixels_qualify_unless_the_formula_is_asked_for() -> None:
    labels = np.arange(SIZE)[:, None] // 2 * 6 + np.arange(SIZE)[None] // 2
    error, _, _ = scene(frames=1)
    hand = torch.zeros(1, SIZE, SIZE, dtype=torch.bool)
    hand[:, 2:10, 3:10] = True
    superpixels = stack_regions([partition(labels)])
    masks = np.stack([labels == u for u in range(36)])

    def share(share_of: str, regions: Regions) -> float:
        module = module_of(PRINTED, share_of, T_E=0.9)
        weights = module(error, regions, hand, torch.zeros(1)).weights.detach()
        return float((weights[hand] > 0.0).double().mean())

    # All but the regions with errors above T_E.
    assert share("auto", superpixels) == share("region", superpixels) > 0.9
    assert share("hand", superpixels) == 0.0
    assert share("auto", stack_regions([overlapping(masks)])) == 0.0


def test_a_covered_region_counts_less_than_a_visible_one() -> None:
    labels = np.zeros((SIZE, SIZE), int)
    labels[:, SIZE // 2 :] = 1
    error = torch.full((1, SIZE, SIZE), 0.02)
    error[:, :, SIZE // 2 :] = 0.6
    hand = torch.ones(1, SIZE, SIZE)
    regions = stack_regions([partition(labels)])
    made = module_of(PRINTED)(error, regions, hand, torch.zeros(1))
    # (1 - 0.6) / (1 - 0.02) at equal shares.
    ratio = made.weights[0, 0, -1] / made.weights[0, 0, 0]
    assert float(ratio.detach()) == pytest.approx(0.4 / 0.98, rel=1e-5)


def test_scaled_weights_are_the_docs_equation() -> None:
    """Oracle: docs/dpd_pao.md, region by region in numpy; 1e-5."""
    error, masks, _ = scene()
    coverage = torch.from_numpy(np.random.default_rng(3).uniform(size=(2, SIZE, SIZE)))
    omega, ordinary = torch.tensor([0.4, 0.0], dtype=torch.float64), 0.4
    module = module_of("scaled", "region", T_E=1.5, T_mu=0.1).double()
    expects = torch.full_like(error, ordinary)
    made = module(error, regions_of(masks), coverage, omega, expects)
    for frame in range(2):
        hand, expected = coverage[frame].numpy() > 0.5, np.zeros((SIZE, SIZE))
        for mask in masks[frame]:
            both = mask & hand
            gate = max(1.0 - error[frame].numpy()[both].mean() / ordinary / 1.5, 0.0)
            gate *= max(both.sum() / mask.sum() - 0.1, 0.0) / 0.9
            expected += gate * mask
        expected *= coverage[frame].numpy()
        np.testing.assert_allclose(made.weights[frame].detach(), expected, atol=1e-5)
        factor = module.temporal_factor(omega)[frame]
        assert float(factor) == pytest.approx(1.0 / (1.0 + 100.0 * omega[frame]))


def test_without_a_running_median_that_of_the_frames_counts() -> None:
    error, masks, hand = scene()
    module = PerturbationAwareWeights()
    made = module(error, regions_of(masks), hand, torch.zeros(2))
    assert float(made.errors.median()) == pytest.approx(1.0)
    again = module(2.0 * error, regions_of(masks), hand, torch.zeros(2))
    torch.testing.assert_close(again.weights, made.weights)


def test_the_temporal_factor_scales_the_regions_as_printed_and_omega_learns_nothing() -> None:
    error, masks, hand = scene()
    module = module_of(PRINTED)
    omega = torch.tensor([0.01, 0.0], requires_grad=True)
    made = module(error, regions_of(masks), hand, omega)
    plain = module(error, regions_of(masks), hand, torch.zeros(2))
    assert (plain.lambdas > 0.0).any()
    torch.testing.assert_close(made.lambdas[0], plain.lambdas[0] / 11.0)
    torch.testing.assert_close(made.lambdas[1], plain.lambdas[1])
    # Outside of the hand the background term is what it was.
    spread = [regions_of(masks).spread(found.lambdas) for found in (made, plain)]
    torch.testing.assert_close(made.weights - spread[0], plain.weights - spread[1])
    made.weights.sum().backward()
    assert omega.grad is None


@settings(max_examples=30, deadline=None)
@given(
    omega=st.one_of(st.floats(-1.0, 1.0), st.sampled_from([-1e-3, 1e-3, -1.0, 1.0])),
    value=st.sampled_from([0.0, 1.0, 0.5, float("nan"), float("inf")]),
    hand=st.sampled_from(["none", "all", "one pixel", "half"]),
    region=st.sampled_from(["whole", "pixels", "none", "empty mask", "whole mask"]),
    share_of=st.sampled_from(["hand", "region"]),
    threshold=st.sampled_from([-0.1, 0.0, 0.3, 1.0]),
    chosen=st.sampled_from([*CONSTANTS]),
)
def test_weights_are_finite_and_not_negative_everywhere(
    omega: float,
    value: float,
    hand: str,
    region: str,
    share_of: str,
    threshold: float,
    chosen: str,
) -> None:
    error = torch.full((1, SIZE, SIZE), value)
    mask = torch.zeros(1, SIZE, SIZE, dtype=torch.bool)
    mask.view(-1)[: {"none": 0, "all": SIZE**2, "one pixel": 1, "half": SIZE**2 // 2}[hand]] = True
    ones = np.ones((1, SIZE, SIZE), bool)
    regions: FrameRegions = {
        "whole": partition(np.zeros((SIZE, SIZE), int)),
        "pixels": partition(np.arange(SIZE**2).reshape(SIZE, SIZE)),
        "none": overlapping(ones[:0]),
        "empty mask": overlapping(~ones),
        "whole mask": overlapping(ones),
    }[region]
    module = module_of(chosen, share_of)
    with torch.no_grad():
        module.T_mu.fill_(threshold)
    if chosen == "released":
        residual = error.nan_to_num(0.0, 0.0)[..., None].expand(-1, -1, -1, 3)
        made = module.released(residual, stack_regions([regions]), mask, mask, 0.7 * mask)
    else:
        made = module(error, stack_regions([regions]), mask, torch.tensor([omega]))
    assert made.weights.isfinite().all()
    assert (made.weights >= 0.0).all()
    made.weights.sum().backward()
    learnt = [value.grad for value in module.parameters() if value.grad is not None]
    assert len(learnt) >= 2
    assert all(grad.isfinite() for grad in learnt)
    if not np.isfinite(value) and chosen != "released":
        assert (made.weights == 0.0).all()


def test_one_bad_pixel_spoils_only_itself() -> None:
    error, masks, hand = scene()
    regions = regions_of(masks)
    module = PerturbationAwareWeights(PRINTED)
    whole = module(error, regions, hand, torch.zeros(2))
    error[0, 3, 4] = float("nan")
    made = module(error, regions, hand, torch.zeros(2))
    assert made.weights[0, 3, 4] == 0.0
    assert made.weights.isfinite().all()
    assert torch.equal(made.weights[1], whole.weights[1])


def test_bad_arguments_are_named() -> None:
    error, masks, hand = scene()
    module = PerturbationAwareWeights()
    with pytest.raises(ShapeMismatch, match="omega"):
        module(error, regions_of(masks), hand, torch.zeros(3))
    with pytest.raises(ShapeMismatch):
        module(error, regions_of(masks), hand[:, 1:], torch.zeros(2))
    with pytest.raises(BadMethod, match="variant"):
        settings_from(PaoSettings, {"variant": "mask"}, "a method")
    with pytest.raises(UsageError, match="hand"):
        PaoSettings(hand="none")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_errors_in_half_precision_weigh_as_the_numbers_that_they_are(dtype: torch.dtype) -> None:
    """Oracle: the same numbers in float64. Tolerance: float32's sums over a region, 1e-5."""
    error, masks, hand = scene(seed=4)
    narrow = error.to(dtype)
    omega = torch.tensor([0.25, -0.5])
    made = [
        PerturbationAwareWeights(PRINTED)(given, regions_of(masks), hand, omega.to(given)).weights
        for given in (narrow, narrow.double())
    ]
    torch.testing.assert_close(made[0].double(), made[1].double(), rtol=1e-5, atol=1e-6)


def test_strided_errors_and_hands_change_no_bit() -> None:
    error, masks, hand = scene(seed=5)
    made = [
        PerturbationAwareWeights(PRINTED)(
            change(error), regions_of(masks), change(hand), torch.zeros(2).double()
        ).weights
        for change in (torch.Tensor.contiguous, lambda x: x.mT.contiguous().mT)
    ]
    assert torch.equal(*made)
