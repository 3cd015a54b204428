"""DPD. Oracles: the paper's formulas written out, the authors' parameter count, autograd."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import BadInput, ShapeMismatch, UsageError
from wildghand.dpd.dpd import (
    DynamicPerturbation,
    FramePerturbation,
    draw_kept,
    encode_frames,
)
from wildghand.gaussians.attributes import SIZES, RawAttributes


def attributes(*lead: int, seed: int = 0) -> RawAttributes:
    generator = torch.Generator().manual_seed(seed)
    return RawAttributes.split(torch.randn(*lead, 14, generator=generator))


def trained(frame_count: int = 7, width: int = 16) -> DynamicPerturbation:
    """A module whose temporal weights are not zero."""
    torch.manual_seed(3)
    module = DynamicPerturbation(frame_count, width)
    torch.nn.init.normal_(module.psi.weight)
    return module


def test_layers_and_parameters_are_the_authors() -> None:
    module = DynamicPerturbation(300)
    shapes = {name: tuple(value.shape) for name, value in module.named_parameters()}
    expected = {
        "phi.0.weight": (256, 21),
        "phi.0.bias": (256,),
        "phi.2.weight": (256, 256),
        "phi.2.bias": (256,),
        "psi.weight": (1, 256),
        "psi.bias": (1,),
    }
    for name, k in SIZES.items():
        expected[f"varphi.{name}.weight"] = (k, k + 256)
        expected[f"varphi.{name}.bias"] = (k,)
    assert shapes == expected
    assert sum(value.numel() for value in module.parameters()) == 75_323
    assert set(module.state_dict()) == set(expected)


def test_encoding_is_the_papers_with_the_raw_value_behind() -> None:
    code = encode_frames(torch.arange(12), 12).double().numpy()
    for frame in range(12):
        l = frame + 1  # noqa: E741 - the paper's name
        waves = [f(2**k * math.pi * l / 12) for k in range(10) for f in (math.sin, math.cos)]
        np.testing.assert_allclose(code[frame], [*waves, l / 12], atol=1e-7)


def test_every_frame_has_an_encoding_of_its_own() -> None:
    for count in (1, 2, 64, 1662):
        code = encode_frames(torch.arange(count), count)
        assert len(torch.unique(code, dim=0)) == count


def test_at_the_start_nothing_changes() -> None:
    module = DynamicPerturbation(5)
    temporal = module.temporal(torch.arange(5))
    assert (temporal.omega == 0.0).all()
    biases = module.biases(attributes(5, 11), temporal.z, temporal.omega)
    assert all((tensor == 0.0).all() for _, tensor in biases.items())


def test_learning_starts_although_nothing_changes_at_the_start() -> None:
    torch.manual_seed(0)
    module = DynamicPerturbation(4, 32)
    optimizer = torch.optim.Adam(module.parameters(), 3e-2)
    raw = attributes(4, 20)
    target = torch.tensor([0.0, 0.0, 0.3, -0.3])[:, None, None]
    losses = []
    for _ in range(80):
        temporal = module.temporal(torch.arange(4))
        colors = module.biases(raw, temporal.z, temporal.omega).logit_colors
        loss = (colors - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        if not losses:
            assert module.psi.weight.grad.abs().max() > 0.0
            assert module.varphi["logit_colors"].weight.grad.abs().max() == 0.0
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.05 * losses[0]


@pytest.mark.parametrize("shared", [True, False])
def test_biases_are_the_concatenated_form(shared: bool) -> None:
    module = trained().double()
    raw = attributes(*(() if shared else (3,)), 9).map(torch.Tensor.double)
    temporal = module.temporal(torch.tensor([0, 6, 2]))
    biases = module.biases(raw, temporal.z, temporal.omega)
    for name, g in raw.items():
        whole = torch.cat(
            [temporal.z[:, None].expand(3, 9, -1), g.expand(3, 9, g.shape[-1])], dim=-1
        )
        expected = temporal.omega[:, None, None] * module.varphi[name](whole)
        torch.testing.assert_close(getattr(biases, name), expected, rtol=0.0, atol=1e-14)


def test_float32_gradients_are_those_of_float64() -> None:
    gradients = []
    for dtype in (torch.float32, torch.float64):
        module = trained().to(dtype)
        raw = attributes(2, 9).map(lambda tensor, dtype=dtype: tensor.to(dtype))
        temporal = module.temporal(torch.tensor([1, 5]))
        module.biases(raw, temporal.z, temporal.omega).concatenate().square().mean().backward()
        gradients.append([value.grad.double() for value in module.parameters()])
    for single, double in zip(*gradients, strict=True):
        assert (single - double).norm() <= 1e-4 * double.norm()


def test_one_frame_works() -> None:
    module = trained(frame_count=1)
    temporal = module.temporal(torch.tensor([0]))
    assert (
        module.biases(attributes(1, 4), temporal.z, temporal.omega).concatenate().isfinite().all()
    )


@settings(max_examples=20, deadline=None)
@given(logit=st.floats(-1e30, 1e30))
def test_omega_stays_in_its_range(logit: float) -> None:
    module = DynamicPerturbation(2, 4)
    with torch.no_grad():
        module.psi.bias.fill_(logit)
    omega = module.temporal(torch.arange(2)).omega
    assert (omega.abs() <= 1.0).all()


def test_frames_are_dropped_with_their_probability_and_repeat() -> None:
    chance = torch.zeros(4000)
    chance[:2000] = 0.3
    kept = draw_kept(chance, torch.Generator().manual_seed(1))
    assert torch.equal(kept, draw_kept(chance, torch.Generator().manual_seed(1)))
    assert kept[2000:].all()
    # Four standard deviations of a binomial share.
    assert abs(float((~kept[:2000]).float().mean()) - 0.3) < 4 * math.sqrt(0.21 / 2000)
    assert not draw_kept(torch.ones(100), torch.Generator()).any()


def test_a_dropped_frame_has_no_weight_and_no_gradient_and_costs_no_global_random_number() -> None:
    module, state = trained(), torch.get_rng_state()
    kept = draw_kept(torch.tensor([1.0, 0.0]), torch.Generator())
    assert torch.equal(state, torch.get_rng_state())
    temporal = module.temporal(torch.arange(2))
    (own,) = torch.autograd.grad(
        FramePerturbation(module, temporal, kept).omega.sum(), temporal.omega
    )
    assert own.tolist() == [0.0, 1.0]


def test_bad_arguments_are_named() -> None:
    module = trained()
    temporal = module.temporal(torch.arange(2))
    for frames in ([7], [-1, 0]):
        with pytest.raises(UsageError, match="frames"):
            module.temporal(torch.tensor(frames))
    with pytest.raises(ShapeMismatch):
        module.biases(attributes(3, 4), temporal.z, temporal.omega)
    with pytest.raises(UsageError, match="frame_count"):
        DynamicPerturbation(0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_attributes_of_another_type_are_one_message(dtype: torch.dtype) -> None:
    module = trained()
    temporal = module.temporal(torch.arange(2))
    other = RawAttributes.split(attributes(2, 5).concatenate().to(dtype))
    with pytest.raises(BadInput, match=r"that of the module torch\.float32") as caught:
        module.biases(other, temporal.z, temporal.omega)
    assert "raw.offsets" in str(caught.value)


def test_strided_attributes_give_the_biases_of_contiguous_ones() -> None:
    """To an ulp of the largest: BLAS sums in another order where rows are not contiguous."""
    module = trained()
    temporal = module.temporal(torch.arange(2))
    whole = attributes(2, 5).concatenate()
    strided = whole.movedim(-1, 0).contiguous().movedim(0, -1)
    assert not strided.is_contiguous()
    made = [
        module.biases(RawAttributes.split(g), temporal.z, temporal.omega).concatenate()
        for g in (whole, strided)
    ]
    assert float((made[0] - made[1]).detach().abs().max()) <= 4.0 * torch.finfo().eps


def test_the_pose_head_by_time_starts_at_rest_and_keeps_its_bounds() -> None:
    generator = torch.Generator().manual_seed(0)
    pose, transl = torch.rand(3, 16, 3, generator=generator), torch.rand(3, 3, generator=generator)
    bare, module = DynamicPerturbation(6, 8), DynamicPerturbation(6, 8, poses=(0.01, 0.002))
    z = module.temporal(torch.tensor([0, 2, 5])).z
    for made in (bare, module):
        moved = made.move(pose, transl, z)
        assert torch.equal(moved[0], pose)
        assert torch.equal(moved[1], transl)
    head = module.pose_head
    assert head is not None
    torch.nn.init.normal_(head[2].weight, std=100.0)
    moved = module.move(pose, transl, z)
    for found, start, bound in ((moved[0], pose, 0.01), (moved[1], transl, 0.002)):
        step = (found - start).detach().abs()
        assert 0.9 * bound < float(step.max()) <= bound * 1.001
        # Frames differ by their embedding alone.
        assert not torch.equal(step[0], step[1])
