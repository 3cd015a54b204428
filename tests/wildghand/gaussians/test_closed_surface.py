"""Closed surfaces.

Oracles: covariances by SciPy's rotations in float64, 1e-5; autograd in float64; a turntable.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks.turntable import VIEWS, View, sheet, turn
from hwp_bench.capture.schema import HandModelId
from hwp_bench.hands import load_template
from wildghand.avatar.avatar import FitRecord, WildGHandAvatar
from wildghand.gaussians.attributes import Activation, RawAttributes
from wildghand.gaussians.regularizers import off_surface
from wildghand.model.model import make_model
from wildghand.model.settings import read_settings
from wildghand.network import NetworkOutput

SPACING = 0.003


def random_raw(count: int) -> torch.Tensor:
    random = torch.Generator().manual_seed(0)
    return torch.randn(2, count, 14, generator=random, dtype=torch.float64)


def expected(raw: torch.Tensor, flatness: float) -> float:
    """The definition, Gaussian by Gaussian, from whole covariances."""
    drawn, total = Activation()(RawAttributes.split(raw)), []
    for offset, scale, quat, opacity in zip(
        drawn.offsets.reshape(-1, 3) / SPACING,
        drawn.scales.reshape(-1, 3) / SPACING,
        drawn.quats.reshape(-1, 4),
        drawn.opacities.reshape(-1),
        strict=True,
    ):
        turned = Rotation.from_quat(quat.numpy(), scalar_first=True).as_matrix()
        covariance = turned @ np.diag(scale.numpy() ** 2) @ turned.T
        skin = covariance[:2, :2]
        terms = [
            abs(float(offset[2])) + 2.0 * math.sqrt(covariance[2, 2]) - 0.8,
            math.hypot(float(offset[0]), float(offset[1])) - 0.5,
            math.log(0.6) - 0.25 * math.log(np.linalg.det(skin)),
            math.sqrt(np.trace(skin)) - 1.5,
            2.0 * (0.98 - float(opacity)),
            math.sqrt(flatness) * (2.0 * math.sqrt(covariance[2, 2]) - 0.4),
        ]
        total.append(sum(max(0.0, term) ** 2 for term in terms))
    return float(np.mean(total))


FLATNESS = pytest.mark.parametrize("flatness", [0.0, 5.0])


@FLATNESS
def test_it_is_its_definition(flatness: float) -> None:
    raw = random_raw(40)
    found = off_surface(RawAttributes.split(raw), Activation(), SPACING, flatness=flatness)
    # The small constants under the roots.
    assert float(found) == pytest.approx(expected(raw, flatness), rel=1e-5)


def hard_raw() -> torch.Tensor:
    """Gaussians on both sides of every bound, and of no length or thickness."""
    raw = random_raw(3000)
    raw[0] *= 3.0
    raw[0, :500, 10] += 6.0
    raw[1, :40, 3:6] = torch.tensor([-9.0, 2.0, 2.0], dtype=raw.dtype)  # beyond both limits
    raw[1, 40:80, :3] = 0.0
    raw[1, 80:120, 6:10] *= 1e-3
    raw[1, 120:160, 10] = 90.0
    raw[1, 160:200, 10] = -90.0
    return raw


@FLATNESS
def test_float32_is_exact_enough(flatness: float) -> None:
    """Oracle: autograd in float64 on the same numbers; 1e-5 of the value, 1e-4 of the gradient."""
    exact, raw = hard_raw().float().double().requires_grad_(), hard_raw().float().requires_grad_()
    activation = Activation(max_offset=0.008)
    values = [
        off_surface(RawAttributes.split(one), activation, SPACING, flatness=flatness)
        for one in (exact, raw)
    ]
    for value in values:
        (3.0 * value).backward()
    assert values[1].item() == pytest.approx(values[0].item(), rel=1e-5)
    assert exact.grad is not None
    assert raw.grad is not None
    # Each channel of a Gaussian next to the whole gradient of that Gaussian.
    size = exact.grad.norm(dim=-1, keepdim=True)
    off = (raw.grad - exact.grad).abs() / size.clamp(min=float(size.mean()))
    assert float(off.max()) < 1e-4
    assert float((exact.grad != 0.0).double().mean()) > 0.4


def test_nothing_but_the_term_closes_a_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hand of which no frame shows anything: scattered and clear Gaussians close."""
    settings = read_settings({"gaussians": 4000, "prior": "", "light.enabled": False})
    template = load_template("anny", "right")
    color, device = torch.full((3,), 0.5), torch.device("cpu")
    model = make_model({"right": template}, settings, color, 1, 0, device)
    hand_model, betas = HandModelId(template.name, "", "anny"), {"right": np.zeros(10)}
    avatar = WildGHandAvatar(model, settings, hand_model, betas, color, 0, FitRecord())
    with torch.no_grad():
        made = model.network("right", torch.ones(1, 4000, 3), torch.zeros(1, 16, 3))
    raw = made.raw.concatenate().clone()
    noise = torch.randn(raw.shape, generator=torch.Generator().manual_seed(0))
    noise[..., 3:6] *= 0.4  # beyond the largest scale the activation is flat
    raw += noise
    raw[:, :2500, 10] -= 9.0
    raw.requires_grad_()
    activation = model.network.activation

    def predict(*_: object) -> NetworkOutput:
        return dataclasses.replace(made, raw=RawAttributes.split(raw.detach()))

    monkeypatch.setattr(model, "predict", predict)
    before = list(turn(avatar, "right", 128))
    optimizer = torch.optim.Adam([raw], lr=0.1)
    for _ in range(150):
        optimizer.zero_grad()
        off_surface(RawAttributes.split(raw), activation, model.rigs["right"].spacing).backward()
        optimizer.step()
    after = list(turn(avatar, "right", 128))
    assert max(view.hole for view in before) > 20
    assert max(view.hole for view in after) <= 2
    # Discs of the greatest width that costs nothing still stand off the fingertips.
    fur = [np.mean([view.fur for view in views]) for views in (before, after)]
    assert fur[1] < 0.35 * fur[0]
    assert sheet(after).shape == (2 * 128, VIEWS * 128, 3)


def test_a_view_finds_a_hole_and_fur() -> None:
    silhouette = np.zeros((40, 40), dtype=bool)
    silhouette[10:30, 10:30] = True
    rgba = np.repeat(silhouette[..., None], 4, axis=2).astype(np.float32)
    assert (View(rgba, silhouette).hole, View(rgba, silhouette).fur) == (0, 0.0)
    rgba[15:17, 15:18] = 0.0  # a hole of 6 px
    rgba[11, 11:29] = 0.0  # at the rim: none
    rgba[2:4, 20] = 0.5  # fur
    view = View(rgba, silhouette)
    assert (view.hole, view.fur) == (6, pytest.approx(1.0))
