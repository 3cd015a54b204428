"""Fits that are drawn otherwise with visibility and fill, and a light to compare under."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import torch

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Component, Fit
from wildghand.light import KnownLight
from wildghand.model.settings import read_settings

Kind = TypeVar("Kind", bound=Component)


def a_light(cosine: float = 0.5) -> KnownLight:
    """Known around the direction to a camera that looks along +z."""
    return KnownLight(
        directions=torch.eye(3),
        strengths=torch.ones(3),
        ambient=torch.tensor(0.3),
        axis=torch.tensor([0.0, 0.0, -1.0]),
        cosine=torch.tensor(cosine),
    )


def odd_fit(training: TrainingCapture, settings: Mapping[str, Any]) -> Fit:
    """A fit before its first step, whose Gaussians have places and colours as chance wills."""
    fit = make_fit(training, read_settings(settings), 0, torch.device("cpu"))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for value in fit.model.network.parameters():
            value.add_(0.1 * torch.randn(value.shape, generator=generator))
    return fit


def part(fit: Fit, kind: type[Kind]) -> Kind:
    """The component of a kind, which a fit must have."""
    found = fit.part(kind)
    assert found is not None
    return found
