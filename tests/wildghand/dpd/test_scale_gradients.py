"""What the canonical hand learns from a frame; oracle: gradients without shares, scaled."""

from __future__ import annotations

import torch

from wildghand.dpd.temporal import scale_gradients
from wildghand.gaussians.attributes import SIZES, RawAttributes
from wildghand.network import NetworkOutput
from wildghand.network.network import Refinement

FRAMES, GAUSSIANS = 3, 5
SHARES = torch.tensor([1.0, 0.25, 0.0])


def _prediction(seed: int) -> NetworkOutput:
    generator = torch.Generator().manual_seed(seed)

    def leaf(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator).requires_grad_()

    return NetworkOutput(
        raw=RawAttributes(**{name: leaf(FRAMES, GAUSSIANS, k) for name, k in SIZES.items()}),
        shadow=leaf(FRAMES, GAUSSIANS, 1),
        template_offsets=leaf(GAUSSIANS, 3),
        refinement=Refinement(leaf(FRAMES, 16, 3), leaf(10), leaf(FRAMES, 3)),
        xi=leaf(FRAMES, GAUSSIANS, 1),
    )


def _gradients(prediction: NetworkOutput, used: NetworkOutput) -> dict[str, torch.Tensor]:
    """Of the sum of squares of what is used, frame by frame."""
    loss = used.shadow.square().sum() + used.xi.square().sum()
    loss = loss + used.refinement.pose.square().sum()
    loss = loss + used.refinement.transl.square().sum()
    loss = loss + used.refinement.betas.expand(FRAMES, -1).square().sum()
    loss = loss + used.template_offsets.expand(FRAMES, -1, -1).square().sum()
    for _, values in used.raw.items():
        loss = loss + values.square().sum()
    loss.backward()
    found = {name: values.grad for name, values in prediction.raw.items()}
    found |= {
        "shadow": prediction.shadow.grad,
        "xi": prediction.xi.grad,
        "pose": prediction.refinement.pose.grad,
        "transl": prediction.refinement.transl.grad,
        "betas": prediction.refinement.betas.grad,
        "template_offsets": prediction.template_offsets.grad,
    }
    assert all(gradient is not None for gradient in found.values())
    return {name: gradient for name, gradient in found.items() if gradient is not None}


def test_values_stand_and_gradients_are_shares() -> None:
    whole, shared = _prediction(0), _prediction(0)
    used = scale_gradients(shared, SHARES)
    for (_, one), (_, other) in zip(whole.raw.items(), used.raw.items(), strict=True):
        assert torch.equal(one, other)
    torch.testing.assert_close(used.template_offsets, whole.template_offsets.expand(FRAMES, -1, -1))
    expected, found = _gradients(whole, whole), _gradients(shared, used)
    for name, gradient in found.items():
        if name in ("betas", "template_offsets"):
            # Every frame gave the same part of the whole gradient.
            wanted = expected[name] / FRAMES * SHARES.sum()
        else:
            wanted = expected[name] * SHARES.reshape(-1, *[1] * (gradient.ndim - 1))
        torch.testing.assert_close(gradient, wanted, msg=name)


def test_a_bias_learns_from_all_of_a_frame() -> None:
    prediction = _prediction(1)
    bias = torch.zeros(FRAMES, GAUSSIANS, 1, requires_grad=True)
    (scale_gradients(prediction, torch.zeros(FRAMES)).shadow + bias).square().sum().backward()
    assert prediction.shadow.grad is not None
    assert not prediction.shadow.grad.any()
    assert bias.grad is not None
    torch.testing.assert_close(bias.grad, 2.0 * prediction.shadow.detach())
