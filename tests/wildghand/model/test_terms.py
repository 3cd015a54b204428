"""Terms. Oracles: the definitions in numpy; gradcheck in float64; float32 against it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from hwp_bench.base.errors import ShapeMismatch
from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.perceptual import FilterBankLoss
from wildghand.model import terms


def uniform(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


IMAGE, TARGET, WEIGHTS = uniform(2, 5, 4, 3), uniform(2, 5, 4, 3, seed=1), uniform(2, 5, 4, seed=2)

#: Each term as a function of tensors that get a gradient.
TERMS: dict[str, tuple[Callable[..., torch.Tensor], tuple[torch.Tensor, ...]]] = {
    "reconstruction": (
        lambda image, weights: terms.reconstruction(image, TARGET.to(image), weights),
        (IMAGE, WEIGHTS),
    ),
    "reconstruction with D-SSIM": (
        lambda image, weights: terms.reconstruction(image, TARGET.to(image), weights, 0.2),
        (IMAGE, WEIGHTS),
    ),
    "bias": (
        lambda channels: terms.bias_size(RawAttributes.split(channels)),
        (uniform(2, 5, 14) - 0.5,),
    ),
    "distance to one": (terms.distance_to_one, (uniform(7, 2),)),
    "norm of the distance": (
        lambda values: terms.distance_to_one(values, squared=False),
        (uniform(7, 2),),
    ),
    "silhouette": (
        lambda coverage: terms.silhouette(coverage, TARGET[..., 0] > 0.5),
        (IMAGE[..., :1],),
    ),
    "reward": (terms.weight_reward, (WEIGHTS,)),
    "cross": (terms.cross_hand, (uniform(6, 4), uniform(6, 4, seed=3))),
    "filter bank": (
        lambda image, weights: FilterBankLoss()(image, TARGET.to(image), weights),
        (IMAGE, WEIGHTS),
    ),
}


@pytest.mark.parametrize("name", TERMS)
def test_gradients_are_the_differences_and_float32_agrees(name: str) -> None:
    function, values = TERMS[name]
    doubles = [value.clone().requires_grad_(True) for value in values]
    assert torch.autograd.gradcheck(function, doubles, atol=1e-7)
    singles = [value.float().requires_grad_(True) for value in values]
    exact = torch.autograd.grad(function(*doubles), doubles)
    rounded = torch.autograd.grad(function(*singles), singles)
    for single, double in zip(rounded, exact, strict=True):
        assert (single.double() - double).norm() <= 1e-4 * double.norm()


def test_values_are_the_definitions() -> None:
    image, target, weights = IMAGE.numpy(), TARGET.numpy(), WEIGHTS.numpy()
    expected = (weights[..., None] * np.abs(image - target)).mean()
    assert float(terms.reconstruction(IMAGE, TARGET, WEIGHTS)) == pytest.approx(expected)
    channels = uniform(2, 5, 14) - 0.5
    assert float(terms.bias_size(RawAttributes.split(channels))) == pytest.approx(
        channels.abs().sum(-1).mean().item()
    )
    assert float(terms.distance_to_one(torch.tensor([0.5, 1.0]))) == 0.125
    assert float(terms.distance_to_one(torch.tensor([0.5, 1.0]), squared=False)) == 0.25
    assert float(terms.silhouette(torch.ones(1, 2, 2), torch.eye(2)[None] > 0)) == 0.5
    assert float(terms.weight_reward(torch.tensor([1.0, 3.0]))) == -2.0
    assert float(terms.cross_hand(torch.zeros(2, 2), torch.eye(2))) == 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_pixels_that_are_not_finite_are_left_out(dtype: torch.dtype, share: float) -> None:
    target = TARGET.to(dtype).clone()
    target[0, 2, 3, 1] = float("nan")
    target[1] = float("inf")
    image = IMAGE.to(dtype).clone().requires_grad_(True)
    loss = terms.reconstruction(image, target, WEIGHTS.to(dtype), share)
    loss.backward()
    assert loss.isfinite()
    assert image.grad.isfinite().all()
    assert (image.grad[1] == 0.0).all()
    assert share > 0.0 or (image.grad[0, 2, 3] == 0.0).all()
    assert FilterBankLoss()(image, target, WEIGHTS.to(dtype)).isfinite()


def test_gains_of_clean_frames_and_tints_of_all_are_charged() -> None:
    gains = torch.tensor([[0.1, 0.1, 0.1], [-0.3, 0.0, 0.6], [0.0, 0.0, 0.0]], requires_grad=True)
    clean = torch.tensor([1.0, 0.25, 1.0])
    # By hand: frames count by how clean they are; a grey gain has no tint.
    size = (0.01 + 0.25 * (0.09 + 0.36) / 3) / 3
    assert float(terms.gain_of_clean(gains, clean).detach()) == pytest.approx(size, rel=1e-6)
    tint = terms.tint_of_gains(gains)
    assert float(tint.detach()) == pytest.approx((0.16 + 0.01 + 0.25) / 9, rel=1e-6)
    tint.backward()
    assert gains.grad is not None
    torch.testing.assert_close(gains.grad[[0, 2]], torch.zeros(2, 3), atol=1e-8, rtol=0)
    torch.testing.assert_close(gains.grad.sum(dim=1), torch.zeros(3), atol=1e-7, rtol=0)


def test_no_weight_no_loss() -> None:
    image = IMAGE.clone().requires_grad_(True)
    loss = terms.reconstruction(image, TARGET, torch.zeros_like(WEIGHTS), 0.2)
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert (image.grad == 0.0).all()


def test_inexact_poses_leave_at_most_the_lesser_share_to_dssim() -> None:
    chosen = terms.TermSettings(dssim_weight=0.4)
    assert chosen.dssim_share(exact_poses=True) == 0.4
    assert chosen.dssim_share(exact_poses=False) == terms.DSSIM_INEXACT == 0.05
    # Whoever asks for less, as the paper does, gets it with any poses.
    assert terms.TermSettings(dssim_weight=0.0).dssim_share(exact_poses=False) == 0.0


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ShapeMismatch):
        terms.reconstruction(IMAGE, TARGET[:1], WEIGHTS)
    with pytest.raises(ShapeMismatch, match="weights"):
        terms.reconstruction(IMAGE, TARGET, WEIGHTS[:1])
    with pytest.raises(ShapeMismatch, match="hand"):
        terms.silhouette(WEIGHTS, WEIGHTS[:1])
    with pytest.raises(ShapeMismatch, match="left, right"):
        terms.cross_hand(torch.zeros(3, 2), torch.zeros(4, 2))
