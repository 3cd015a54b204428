"""The heads' bounds and starts, by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from wildghand.gaussians.attributes import CHANNELS
from wildghand.network.heads import AttributeHead, RefinementHead, ShadowHead, TemplateHead
from wildghand.network.settings import network_settings
from wildghand.network.surface import POSITION_CHANNELS

SETTINGS = network_settings("compact", head_width=4, identity_channels=15)
TEXTURE, GEOMETRY, COUNT, FRAMES = 17, 5, 3, 2


def stirred(head: torch.nn.Module) -> torch.nn.Module:
    """Float64, and no weight left at zero."""
    head = head.double()
    random = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in head.parameters():
            noise = torch.randn(parameter.shape, generator=random, dtype=torch.float64)
            parameter.add_(0.3 * noise)
    return head


def inputs(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    x_t = torch.randn(COUNT, TEXTURE, generator=random, dtype=torch.float64)
    x_g = torch.randn(FRAMES, COUNT, GEOMETRY, generator=random, dtype=torch.float64)
    return x_t.requires_grad_(), x_g.requires_grad_()


def start() -> torch.Tensor:
    return torch.linspace(-1, 1, COUNT * CHANNELS).reshape(COUNT, -1).double()


def test_every_head_starts_without_effect() -> None:
    x_t, x_g = inputs()
    no_direct = torch.cat((torch.zeros(COUNT, 15), x_t[:, 15:]), dim=-1)
    head = AttributeHead(SETTINGS, TEXTURE, GEOMETRY).double()
    raw = head(head.texture(no_direct), x_g, no_direct[:, :15], start())
    expected = start().expand(FRAMES, -1, -1)
    torch.testing.assert_close(raw.concatenate(), expected, rtol=0, atol=0)
    shadow = ShadowHead(SETTINGS, GEOMETRY).double()(x_g)
    torch.testing.assert_close(shadow, torch.full_like(shadow, SETTINGS.initial_shadow))
    position = torch.rand(COUNT, POSITION_CHANNELS, dtype=torch.float64)
    assert not TemplateHead(SETTINGS, TEXTURE).double()(x_t, position).any()
    refinement = RefinementHead(SETTINGS, TEXTURE, GEOMETRY).double()
    hand = x_t.mean(dim=0)
    for part in (*refinement(hand, x_g.mean(dim=1)), refinement.shape_change(hand)):
        assert not part.any()


def test_bounds_hold_for_huge_features() -> None:
    x_t, x_g = (1e6 * features for features in inputs())
    offsets = stirred(TemplateHead(SETTINGS, TEXTURE))(x_t, x_t.new_ones(COUNT, POSITION_CHANNELS))
    assert 0.0 < offsets.abs().max() <= SETTINGS.max_template_offset
    refinement = stirred(RefinementHead(SETTINGS, TEXTURE, GEOMETRY))
    pose, transl = refinement(x_t.mean(dim=0), x_g.mean(dim=1))
    betas = refinement.shape_change(x_t.mean(dim=0))
    assert pose.shape == (FRAMES, 16, 3)
    assert betas.shape == (10,)
    assert transl.shape == (FRAMES, 3)
    assert pose.abs().max() <= SETTINGS.max_pose
    assert betas.abs().max() <= SETTINGS.max_betas
    assert transl.abs().max() <= SETTINGS.max_transl


@pytest.mark.parametrize("moves", [False, True])
def test_opacities_follow_the_frame_only_where_they_are_asked_to(moves: bool) -> None:
    """Oracle: the texture branch alone."""
    x_t, x_g = inputs()
    head = stirred(AttributeHead(replace(SETTINGS, frame_opacities=moves), TEXTURE, GEOMETRY))
    hidden, latent = head.texture(x_t), x_t[:, :15]
    raw = head(hidden, x_g, latent, start())
    alone = head(hidden, None, latent, start())
    for name, values in raw.items():
        same = torch.allclose(values, getattr(alone, name).expand_as(values), atol=1e-9)
        assert same == (name == "logit_opacities" and not moves), name
