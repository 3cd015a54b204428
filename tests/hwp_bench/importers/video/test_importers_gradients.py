"""The energy of a clip and its derivatives. Oracle: automatic differentiation in float64."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from synthetic_clip import FOCAL, HEIGHT, WIDTH, make_clip, template, with_correctives

from hwp_bench.hands import HandTemplate, pose_hand
from hwp_bench.hands.articulation import axis_angle_to_matrix, joint_limit_penalty
from hwp_bench.importers.shared.frames import CropWindows
from hwp_bench.importers.video import gradients, residuals
from hwp_bench.importers.video.gradients import ClipEnergy
from hwp_bench.importers.video.model import (
    ANCHOR_UNIT,
    FRAME_OF,
    ClipModel,
    ClipVariables,
    rigid_start,
)
from hwp_bench.importers.video.residuals import LandmarkResidual, OutlineResidual, Outlines

CENTRE = np.array([WIDTH / 2, HEIGHT / 2])
COUNT = 5


def bent_model(hand: HandTemplate, seed: int, size: float) -> tuple[ClipModel, LandmarkResidual]:
    """A clip with every variable away from zero; fingers bend beyond their limits and touch."""
    clip = make_clip(COUNT)
    start = rigid_start(clip.landmarks, clip.joints[0][list(range(16)) + [0] * 5], FOCAL, CENTRE)
    model = ClipModel(hand, start, FOCAL, CENTRE)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for field, share in zip(
            fields(ClipVariables), (1.0, 1.0, 0.1, 0.1, 2.0, 0.02, 0.1, 0.1), strict=True
        ):
            value = getattr(model.variables, field.name)
            value += size * share * torch.randn(value.shape, generator=generator)
    steps = np.array([1.0, 1.5, 0.5, 2.0])
    noise = np.random.default_rng(seed).normal(0, 3.0, (COUNT, 21, 2))
    seen = np.arange(COUNT) != 2
    landmarks = replace(
        clip.landmarks,
        image=clip.landmarks.image + noise,
        score=np.linspace(0.6, 1.0, COUNT),
        detected=seen,
    )
    return model, LandmarkResidual(landmarks, model, steps, 1.1 * FOCAL)


def some_outlines(hand: HandTemplate, seed: int) -> OutlineResidual:
    """Lines near random vertices; some vertices have none."""
    random = np.random.default_rng(seed)
    windows = CropWindows(random.integers(0, 40, (COUNT, 2)), 200, 200)
    made = OutlineResidual(np.ones((COUNT, 4, 4)), np.ones(COUNT, bool), windows, 150.0)
    normal = random.normal(size=(COUNT, 30, 2))
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    normal[:, ::7] = 0.0
    vertices = random.integers(0, len(hand.vertices), (COUNT, 30))
    most = int((hand.weights > 0).sum(axis=1).max())
    bones = np.argsort(-hand.weights, axis=1, kind="stable")[:, :most]
    made.outlines = Outlines(
        vertices,
        hand.vertices[vertices] + random.normal(0, 1e-3, (COUNT, 30, 3)),
        normal,
        np.where(normal[..., 0] == 0.0, 0.0, random.normal(60.0, 30.0, (COUNT, 30))),
        made.corners,
        np.zeros_like(hand.vertices),
        np.ascontiguousarray(hand.shape_basis, np.float64),
        bones,
        np.take_along_axis(hand.weights, bones, axis=1).astype(np.float64),
        made.ratio,
        made.scale,
    )
    return made


class Quadratic:
    """A surface whose energy is a quadratic function of two variables."""

    def add(self, free: dict[str, np.ndarray], slopes: dict[str, np.ndarray]) -> float:
        slopes["turn"] += 2.0 * free["turn"]
        slopes["log_depth"] += 6.0 * free["log_depth"]
        return float((free["turn"] ** 2).sum() + 3.0 * (free["log_depth"] ** 2).sum())


def energy_of(
    model: ClipModel,
    free: dict[str, torch.Tensor],
    terms: LandmarkResidual,
    outline: OutlineResidual | None,
    *,
    afar: bool,
) -> torch.Tensor:
    """The same energy by torch, in float64, written with `pose_hand`."""
    hand, count = model.template.to_torch(torch.float64), len(free["turn"])
    focal, depth = free["log_focal"].exp(), free["log_depth"].exp()
    pose = torch.cat([torch.zeros(count, 1, 3, dtype=torch.float64), free["fingers"]], dim=1)
    posed = pose_hand(hand, pose, free["betas"], torch.zeros(count, 3, dtype=torch.float64))
    rotation = torch.from_numpy(model.start) @ axis_angle_to_matrix(free["turn"])
    wrist = torch.cat([free["anchor"] * (ANCHOR_UNIT / focal) * depth, depth], dim=1)
    place = wrist - (rotation @ posed.joints[:, 0, :, None])[..., 0]
    turned = posed.transforms[:, list(FRAME_OF), :3, :3] @ free["offsets"][..., None]
    points = (posed.landmarks + turned[..., 0]) @ rotation.mT + place[:, None]

    def pixels(of: torch.Tensor) -> torch.Tensor:
        return of[..., :2] / of[..., 2:] * focal + torch.from_numpy(CENTRE)

    def robust(squared: torch.Tensor) -> torch.Tensor:
        return 2.0 * (torch.sqrt(1.0 + squared) - 1.0)

    def fading(squared: torch.Tensor, turn: float) -> torch.Tensor:
        return squared / (1.0 + squared / (4.0 * turn * turn))

    def moved(track: torch.Tensor, unit: float) -> torch.Tensor:
        step = torch.from_numpy(terms.steps)[:, None, None]
        speed = (track[1:] - track[:-1]) / step
        bend = 2.0 * (speed[1:] - speed[:-1]) / (step[1:] + step[:-1]) / unit
        return robust((bend**2).sum(dim=-1)).sum()

    weight, size = torch.from_numpy(terms.weight), free["log_size"]
    error = (((pixels(points) - torch.from_numpy(terms.image)) / terms.image_scale) ** 2).sum(-1)
    centred = (points - points.mean(dim=1, keepdim=True)) * torch.exp(-size)
    world = (((centred - torch.from_numpy(terms.world)) / residuals.WORLD_SCALE) ** 2).sum(-1)
    image = (weight * (robust(error) if afar else fading(error, 2.0))).sum()
    shares = (0.05, 1.0) if afar else (1.0, 0.5)
    value = shares[0] * image + shares[1] * (weight * robust(world)).sum()
    value = value + 0.3 * (moved(points, 0.003) + moved(free["fingers"], 0.06))
    value = value + 300.0 * joint_limit_penalty(pose, terms.limits).sum()
    value = value + 0.02 * (free["fingers"] ** 2).sum()
    spheres = terms.contact
    rest = torch.from_numpy(spheres.centres) + torch.from_numpy(spheres.basis) @ free["betas"]
    motion = posed.transforms[:, torch.from_numpy(spheres.joints)]
    places = (motion[..., :3, :3] @ rest[..., None])[..., 0] + motion[..., :3, 3]
    apart = places[:, terms.pairs[:, 0]] - places[:, terms.pairs[:, 1]]
    length = torch.sqrt((apart**2).sum(dim=-1) + 1e-10)
    overlap = (torch.from_numpy(terms.least) - length).clamp(min=0.0) / 0.003
    value = value + 0.5 * (overlap**2).sum()
    constant = (free["betas"] ** 2).sum() + ((free["offsets"] / 0.004) ** 2).sum()
    constant = constant + (size / 0.05) ** 2
    constant = constant + ((free["log_focal"] - np.log(1.1 * FOCAL)) / 0.15) ** 2
    value = value + 0.5 * terms.prior * constant
    if outline is not None:
        chosen, index = outline.outlines, torch.from_numpy(outline.outlines.vertices)
        shaped = torch.from_numpy(chosen.rest) + hand.shape_basis[index] @ free["betas"]
        blended = torch.einsum("fpk,fkab->fpab", hand.weights[index], posed.transforms)
        skinned = (blended[..., :3, :3] @ shaped[..., None])[..., 0] + blended[..., :3, 3]
        seen = pixels(skinned @ rotation.mT + place[:, None])
        field = (seen - torch.from_numpy(chosen.corners)[:, None]) * chosen.ratio
        distance = (field * torch.from_numpy(chosen.normal)).sum(-1)
        distance = (distance - torch.from_numpy(chosen.target)) / chosen.scale
        value = value + 0.2 * fading(distance**2, 4.0).sum()
    return value


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("size", [0.001, 0.3, 1.0])
@pytest.mark.parametrize("case", ["landmarks", "afar", "outline", "correctives", "left"])
def test_energy_and_derivatives(
    case: str, size: float, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Float64 on both sides: 1e-9 of the largest derivative of a variable."""
    monkeypatch.setattr(gradients, "_BLOCK", COUNT // threads)
    monkeypatch.setattr(gradients.os, "cpu_count", lambda: threads)
    hand = template("left" if case == "left" else "right")
    if case == "correctives":
        hand = with_correctives(hand)
    model, terms = bent_model(hand, 3, size)
    outline = some_outlines(hand, 4) if case in ("outline", "correctives") else None
    found, slopes = ClipEnergy(terms, outline, afar=case == "afar").differentiate(model)
    free = {
        name: torch.from_numpy(value).requires_grad_(True)
        for name, value in model.variables.read().items()
    }
    value = energy_of(model, free, terms, outline, afar=case == "afar")
    value.backward()
    assert found == pytest.approx(float(value.detach()), rel=1e-10)
    for name, leaf in free.items():
        assert leaf.grad is not None
        expected = leaf.grad.numpy()
        assert slopes[name].shape == expected.shape
        np.testing.assert_allclose(
            slopes[name], expected, rtol=0, atol=1e-9 * np.abs(expected).max(), err_msg=name
        )


def test_torch_gets_the_derivatives_and_a_surface_adds_its_own() -> None:
    """Float32 variables: 1e-5."""
    model, terms = bent_model(template(), 1, 0.2)
    value = ClipEnergy(terms, surface=Quadratic())(model)  # type: ignore[arg-type]
    (2.0 * value).backward()
    _, slopes = ClipEnergy(terms).differentiate(model)
    slopes["turn"] += 2.0 * model.variables.read()["turn"]
    slopes["log_depth"] += 6.0 * model.variables.read()["log_depth"]
    for name, slope in slopes.items():
        leaf = getattr(model.variables, name)
        np.testing.assert_allclose(leaf.grad.numpy(), 2.0 * slope, rtol=1e-5, atol=1e-5)
