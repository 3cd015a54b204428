"""Colours at unknown normals. Oracles: the stated formulas on a network that paints its normals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.rig import AnchorPoses
from wildghand.light import KnownLight
from wildghand.model.frames import carried_on, relit
from wildghand.network import NetworkOutput
from wildghand.visibility.count import camera_centres

COUNT = 40


def prediction_at(normals: Tensor) -> NetworkOutput:
    """A network that paints its normals."""
    shape = normals.shape[:-1]
    raw = RawAttributes(
        offsets=torch.zeros(*shape, 3),
        log_scales=torch.zeros(*shape, 3),
        quats=torch.ones(*shape, 4),
        logit_opacities=torch.zeros(*shape, 1),
        logit_colors=normals.clone(),
    )
    # Only these two are read.
    rest: Any = None
    return NetworkOutput(raw, torch.full((*shape, 1), 0.5), rest, rest, rest)


def a_light() -> KnownLight:
    """From above, known around the direction to a camera that looks along +z."""
    return KnownLight(
        directions=torch.tensor([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]),
        strengths=torch.tensor([1.0, 0.0]),
        ambient=torch.tensor(0.2),
        axis=torch.tensor([0.0, 0.0, -1.0]),
        cosine=torch.tensor(0.5),
    )


def anchors_with(normals: Tensor) -> AnchorPoses:
    """Anchors at the origin whose third axis is the normal: a half turn about the middle."""
    z = torch.tensor([0.0, 0.0, 1.0])
    middle = torch.nn.functional.normalize(normals + z, dim=-1)
    quats = torch.cat([torch.zeros_like(middle[..., :1]), middle], dim=-1)
    return AnchorPoses(torch.zeros_like(normals), quats)


def view_from(place: tuple[float, float, float]) -> Tensor:
    viewmat = torch.eye(4)[None].clone()
    viewmat[0, :3, 3] = -torch.tensor(place)
    return viewmat


def some_normals(low: float, high: float) -> Tensor:
    """(1, COUNT, 3) with the cosine to the light's axis between two numbers."""
    rng = np.random.default_rng(1)
    cosine = rng.uniform(low, high, COUNT)
    angle = rng.uniform(0.0, 2.0 * np.pi, COUNT)
    side = np.sqrt(1.0 - cosine**2)
    made = np.column_stack([side * np.cos(angle), side * np.sin(angle), -cosine])
    return torch.tensor(made, dtype=torch.float32)[None]


def test_the_centre_of_a_camera() -> None:
    np.testing.assert_allclose(camera_centres(view_from((1.0, 2.0, 3.0))), [[1.0, 2.0, 3.0]])


def test_known_normals_stay_as_they_are() -> None:
    normals = some_normals(0.6, 0.99)
    before = prediction_at(normals)
    after = relit(before, a_light(), prediction_at, anchors_with(normals), view_from((0, 0, -1.0)))
    assert after is before


def test_unknown_normals_that_face_the_camera_take_the_nearest_known_colour() -> None:
    # The camera stands where the axis points away from: these normals were never shown.
    normals, light = some_normals(-0.95, -0.5), a_light()
    after = relit(
        prediction_at(normals),
        light,
        prediction_at,
        anchors_with(normals),
        view_from((0.0, 0.0, 1.0)),
    )
    known = light.nearest_known(normals)
    torch.testing.assert_close(after.raw.logit_colors, known, rtol=0.0, atol=1e-5)
    expected = 0.5 * light.ratio(normals, known)[..., None]
    torch.testing.assert_close(after.shadow, expected, rtol=1e-4, atol=1e-5)
    # Light comes from above (-y): skin that looks down is darker than its nearest known normal.
    assert (light.irradiance(normals) <= light.irradiance(known) + 1e-6).all()


def test_the_rim_keeps_the_networks_colours() -> None:
    # Normals that face away from the camera, unknown or not.
    normals = some_normals(-0.95, -0.5)
    before = prediction_at(normals)
    after = relit(before, a_light(), prediction_at, anchors_with(normals), view_from((0, 0, -1.0)))
    assert after is before


def test_a_share_mixes_both() -> None:
    first, second = (prediction_at(some_normals(*part)) for part in ((-0.9, -0.6), (0.6, 0.9)))
    second = replace(second, shadow=torch.full((1, COUNT, 1), 0.25))
    share = torch.linspace(0.0, 1.0, COUNT)[None]
    mixed = carried_on(first, second, torch.full((1, COUNT), 2.0), share)
    torch.testing.assert_close(mixed.shadow, torch.full((1, COUNT, 1), 0.5))
    torch.testing.assert_close(mixed.raw.logit_colors[:, 0], first.raw.logit_colors[:, 0])
    torch.testing.assert_close(mixed.raw.logit_colors[:, -1], second.raw.logit_colors[:, -1])
