"""Oracles: closed forms and torch's own functions; float64, 1e-12."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import ShapeMismatch
from wildghand.gaussians.attributes import CHANNELS, SIZES, Activation, RawAttributes


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
