"""Attributes of Gaussians on the skin. Oracles: closed forms, torch's own functions (float64,
1e-12), and rigid motion by scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import ShapeMismatch
from wildghand.gaussians.attributes import (
    CHANNELS,
    MAX_LOGIT,
    SIZES,
    Activation,
    AnchoredGaussians,
    RawAttributes,
    flat_gaussians,
)


def random_attributes(*shape: int, seed: int = 0) -> RawAttributes:
    random = torch.Generator().manual_seed(seed)
    channels = torch.randn(*shape, CHANNELS, generator=random, dtype=torch.float64)
    return RawAttributes.split(channels)


@settings(deadline=None, max_examples=20)
@given(lead=st.lists(st.integers(0, 3), max_size=2), count=st.integers(0, 5))
def test_taking_apart_and_putting_together_changes_nothing(lead: list[int], count: int) -> None:
    raw = random_attributes(*lead, count)
    assert len(raw) == count
    assert {name: tensor.shape[-1] for name, tensor in raw.items()} == dict(SIZES)
    torch.testing.assert_close(
        RawAttributes.split(raw.concatenate()).concatenate(), raw.concatenate(), rtol=0, atol=0
    )


def test_activation_by_closed_forms() -> None:
    raw = random_attributes(2, 5)
    activation = Activation(max_offset=0.01875, log_scale_bias=-5.0, max_scale=100.0)
    drawn = activation(raw)
    # The authors' spelling of the offset.
    wanted = (torch.sigmoid(raw.offsets) - 0.5) * 1.2 / 32.0
    torch.testing.assert_close(drawn.offsets, wanted, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(drawn.scales, torch.exp(raw.log_scales) * torch.e**-5.0)
    torch.testing.assert_close(drawn.quats, raw.quats / raw.quats.norm(dim=-1, keepdim=True))
    torch.testing.assert_close(drawn.opacities, torch.sigmoid(raw.logit_opacities)[..., 0])
    torch.testing.assert_close(drawn.colors, torch.sigmoid(raw.logit_colors))


def test_activated_attributes_stay_in_range_whatever_is_predicted() -> None:
    for value in (-1e6, 1e6):
        drawn = Activation()(random_attributes(3).map(lambda tensor, v=value: tensor * 0 + v))
        assert drawn.offsets.abs().max() <= 0.01875
        assert drawn.scales.min() >= 2e-5 * (1 - 1e-9)
        assert drawn.scales.max() <= 1e-2 * (1 + 1e-9)
        for name in ("quats", "opacities", "colors"):
            assert getattr(drawn, name).abs().max() <= 1.0


@pytest.mark.parametrize("name", SIZES)
def test_wrong_shapes_are_refused_by_name(name: str) -> None:
    parts = dict(random_attributes(3).items())
    parts[name] = parts[name][..., :-1]
    with pytest.raises(ShapeMismatch, match=name):
        RawAttributes(**parts)
    with pytest.raises(ShapeMismatch, match="channels"):
        RawAttributes.split(torch.zeros(3, CHANNELS + 1))


def random_gaussians(count: int, seed: int = 0) -> AnchoredGaussians:
    random = np.random.default_rng(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.from_numpy(random.normal(size=shape))

    return AnchoredGaussians(
        offsets=0.01 * normal(count, 3),
        log_scales=normal(count, 3) - 6.0,
        quats=normal(count, 4),
        logit_opacities=normal(count),
        logit_colors=normal(count, 3),
    )


def to_quat(rotation: Rotation) -> torch.Tensor:
    return torch.from_numpy(rotation.as_quat()[..., [3, 0, 1, 2]])


def covariances(quats: torch.Tensor, scales: torch.Tensor) -> np.ndarray:
    turn = Rotation.from_quat(quats.reshape(-1, 4).numpy()[:, [1, 2, 3, 0]]).as_matrix()
    stretched = turn * np.broadcast_to(scales.numpy(), (*quats.shape[:-1], 3)).reshape(-1, 1, 3)
    return stretched @ stretched.transpose(0, 2, 1)


def test_gaussians_move_rigidly_with_their_anchors() -> None:
    """Turning and shifting every anchor turns and shifts means and covariances; 1e-12."""
    gaussians = random_gaussians(7)
    positions = torch.from_numpy(np.random.default_rng(1).normal(size=(1, 7, 3)))
    frames = Rotation.random(7, random_state=2)
    motion, shift = Rotation.from_rotvec([0.3, -1.2, 2.0]), np.array([0.1, 0.2, -0.3])
    before = gaussians.place(positions, to_quat(frames)[None])
    moved = torch.from_numpy(motion.apply(positions[0].numpy()) + shift)
    after = gaussians.place(moved[None], to_quat(motion * frames)[None])
    np.testing.assert_allclose(after.means[0], motion.apply(before.means[0]) + shift, atol=1e-12)
    turn = motion.as_matrix()
    np.testing.assert_allclose(
        covariances(after.quats, after.scales),
        turn @ covariances(before.quats, before.scales) @ turn.T,
        atol=1e-12,
    )
    assert after.scales is not None
    np.testing.assert_array_equal(after.opacities, before.opacities)


def test_every_attribute_gets_a_gradient() -> None:
    gaussians = random_gaussians(3)
    for tensor in gaussians.parameters().values():
        tensor.requires_grad_()
    placed = gaussians.place(
        torch.zeros(2, 3, 3).double(), to_quat(Rotation.random(6)).view(2, 3, 4)
    )
    total = placed.means.sum() + (placed.quats * placed.quats.detach().roll(1)).sum()
    total = total + placed.scales.sum() + placed.opacities.sum()
    (total + gaussians.logit_colors.sigmoid().sum()).backward()
    for name, tensor in gaussians.parameters().items():
        assert torch.isfinite(tensor.grad).all(), name
        assert tensor.grad.abs().max() > 0, name


def test_flat_gaussians_are_discs_of_the_given_color() -> None:
    """Float32: relative tolerance 1e-5."""
    spacing = torch.tensor([0.001, 0.004])
    disc = flat_gaussians(
        spacing, torch.tensor([0.2, 0.5, 0.9]), opacity=0.8, width=0.5, thickness=0.1
    )
    scales = disc.log_scales.exp() / spacing[:, None]
    np.testing.assert_allclose(scales, [[0.5, 0.5, 0.1]] * 2, rtol=1e-5)
    np.testing.assert_allclose(disc.logit_colors.sigmoid(), [[0.2, 0.5, 0.9]] * 2, rtol=1e-5)
    np.testing.assert_allclose(disc.logit_opacities.sigmoid(), [0.8, 0.8], rtol=1e-5)
    np.testing.assert_array_equal(disc.quats, [[1, 0, 0, 0]] * 2)
    assert len(disc) == 2


def test_black_and_white_start_at_finite_logits() -> None:
    disc = flat_gaussians(torch.ones(1), torch.tensor([0.0, 0.5, 1.0]), opacity=0.5)
    np.testing.assert_allclose(disc.logit_colors, [[-MAX_LOGIT, 0.0, MAX_LOGIT]], atol=1e-6)
    assert math.isfinite(float(disc.log_scales.sum()))


def test_anchors_of_another_hand_are_refused() -> None:
    with pytest.raises(ShapeMismatch, match="7 Gaussians"):
        random_gaussians(7).place(torch.zeros(1, 6, 3), torch.zeros(1, 6, 4))
