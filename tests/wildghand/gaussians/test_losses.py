"""Oracles: scikit-image's SSIM away from the border, plain arithmetic, torch's gradcheck."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from hwp_bench.base.errors import ShapeMismatch
from wildghand.gaussians.losses import photometric_loss, ssim_map


def images(seed: int, shape: tuple[int, ...] = (2, 24, 30, 3)) -> torch.Tensor:
    return torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_ssim_inside_is_that_of_scikit_image() -> None:
    x, y = images(0), images(1)
    ours = ssim_map(x, y).numpy()
    for image, other, mine in zip(x.numpy(), y.numpy(), ours, strict=True):
        _, theirs = structural_similarity(
            image,
            other,
            channel_axis=2,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            full=True,
        )
        np.testing.assert_allclose(mine[5:-5, 5:-5], theirs[5:-5, 5:-5], atol=1e-9)


def test_identical_images_have_ssim_one_and_loss_zero() -> None:
    x = images(2)
    np.testing.assert_allclose(ssim_map(x, x), 1.0, atol=1e-12)
    assert float(photometric_loss(x, x, torch.ones(2, 24, 30), 0.4)) == pytest.approx(0, abs=1e-12)


def test_gradient_agrees_with_finite_differences() -> None:
    x, y = images(3, (1, 13, 12, 2)).requires_grad_(), images(4, (1, 13, 12, 2))
    weights = images(5, (1, 13, 12, 2))
    assert torch.autograd.gradcheck(lambda value: (ssim_map(value, y) * weights).sum(), (x,))


def test_gradient_of_flat_images_is_finite() -> None:
    x = torch.zeros(1, 16, 16, 3, requires_grad=True)
    photometric_loss(x, torch.zeros(1, 16, 16, 3), torch.ones(1, 16, 16), 0.5).backward()
    assert torch.isfinite(x.grad).all()


def pair(content: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two images and weights; what is not content is black in both."""
    if content == "narrow":
        return images(9, (1, 9, 6, 3)), images(10, (1, 9, 6, 3)), images(11, (1, 9, 6))
    x, y, w = images(9, (2, 40, 50, 3)), images(10, (2, 40, 50, 3)), images(11, (2, 40, 50))
    y[:, 5:9] = x[:, 5:9]
    inside = torch.zeros(2, 40, 50, 1, dtype=x.dtype)
    if content == "all":
        inside[:] = 1.0
    elif content == "middle":
        inside[0, 20:24, 17:21] = 1.0
    elif content == "corners":
        inside[0, :3, 45:] = 1.0
        inside[1, 39:, :1] = 1.0
    return x * inside, y * inside, w


@pytest.mark.parametrize("content", ["all", "middle", "corners", "nothing", "narrow"])
@pytest.mark.parametrize("dssim_weight", [0.2, 1.0])
def test_the_compiled_loss_agrees_with_torch_in_float64(dssim_weight: float, content: str) -> None:
    """Value to 1e-6; gradients to 1e-5 of the largest entry."""
    x, y, w = pair(content)
    values, gradients = [], []
    for dtype in (torch.float32, torch.float64):
        leaves = [x.to(dtype).requires_grad_(), w.to(dtype).requires_grad_()]
        loss = photometric_loss(leaves[0], y.to(dtype), leaves[1], dssim_weight)
        (3.0 * loss).backward()
        values.append(float(loss.detach()))
        gradients.append([leaf.grad.double() for leaf in leaves])
    assert values[0] == pytest.approx(values[1], abs=1e-6)
    for fast, exact in zip(*gradients, strict=True):
        np.testing.assert_allclose(fast, exact, atol=1e-5 * float(exact.abs().max()) + 1e-12)


def test_the_number_of_threads_changes_no_bit_of_the_compiled_loss() -> None:
    x, y, w = (tensor.float() for tensor in pair("all"))
    made = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            leaf = x.repeat(1, 5, 5, 1).requires_grad_()
            loss = photometric_loss(leaf, y.repeat(1, 5, 5, 1), w.repeat(1, 5, 5), 0.2)
            loss.backward()
            made.append((loss.detach(), leaf.grad))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*made, strict=True))


def test_a_pixel_that_is_no_number_makes_the_loss_none() -> None:
    x, y, w = (tensor.float() for tensor in pair("nothing"))
    x[1, 30, 7, 2] = math.nan
    assert photometric_loss(x, y, w, 0.2).isnan()


def test_weighted_l1_by_hand() -> None:
    prediction = torch.tensor([[[[0.5], [1.0]]]])
    target = torch.tensor([[[[0.0], [0.0]]]])
    weights = torch.tensor([[[1.0, 0.1]]])
    loss = photometric_loss(prediction, target, weights, 0.0)
    assert float(loss) == pytest.approx((0.5 + 0.1) / 2)


def test_pixels_of_weight_zero_carry_no_l1_gradient() -> None:
    x = images(7).requires_grad_()
    weights = torch.ones(2, 24, 30)
    weights[:, :10] = 0.0
    photometric_loss(x, images(8), weights, 0.0).backward()
    assert x.grad[:, :10].abs().max() == 0.0
    assert x.grad[:, 10:].abs().min() > 0.0


@pytest.mark.parametrize(
    ("target", "weights", "field"),
    [((2, 24, 30, 1), (2, 24, 30), "target"), ((2, 24, 30, 3), (2, 24), "weights")],
)
def test_shapes_that_do_not_fit(target: tuple, weights: tuple, field: str) -> None:
    with pytest.raises(ShapeMismatch, match=field):
        photometric_loss(images(0), torch.zeros(target), torch.zeros(weights), 0.2)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype) -> None:
    """Oracle: float32 of the same numbers, to the bit; gradients to half an ulp of the type."""
    x, y, weights = images(7).to(dtype), images(8).to(dtype), images(9, (2, 24, 30)).to(dtype)
    narrow, wide = x.clone().requires_grad_(), x.float().requires_grad_()
    loss = photometric_loss(narrow, y, weights, 0.3)
    expected = photometric_loss(wide, y.float(), weights.float(), 0.3)
    assert loss.dtype == torch.float32
    assert torch.equal(loss, expected)
    # A gradient of one pixel is about 1e-4 of the loss, where float16 is already coarse.
    (1e3 * loss).backward()
    (1e3 * expected).backward()
    assert narrow.grad.dtype == dtype
    assert torch.equal(narrow.grad, wide.grad.to(dtype))
    assert torch.equal(ssim_map(x, y), ssim_map(x.float(), y.float()))


def test_memory_layout_changes_no_bit() -> None:
    x, y, weights = images(10).float(), images(11).float(), images(12, (2, 24, 30)).float()

    def strided(values: torch.Tensor) -> torch.Tensor:
        return values.movedim(-1, 0).contiguous().movedim(0, -1)

    results = []
    for change in (torch.Tensor.contiguous, strided):
        leaf = change(x).detach().requires_grad_()
        loss = photometric_loss(leaf, change(y), change(weights), 0.3)
        results.append((loss, *torch.autograd.grad(loss, leaf), ssim_map(change(x), change(y))))
    assert not strided(x).is_contiguous()
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))
