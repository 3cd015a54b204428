"""Exactness; oracle: the brute-force float64 reference, itself held against finite differences
(gradcheck) and a closed form. Tolerances: image 1e-5, gradients 1e-4, relative L2.
"""

from __future__ import annotations

import math

import pytest
import torch

from wildghand.splat import rasterize
from wildghand.splat.hard_cases import HardScene, clear_pixels, difference, draw, hand_scene

IMAGE = 1e-5
GRADIENT = 1e-4


def random_scene(seed: int, count: int, width: int, height: int, cameras: int = 1) -> HardScene:
    """Gaussians of all sizes over and beyond the image, seen by cameras that are turned."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    turn = torch.linalg.qr(torch.eye(3, dtype=torch.float64) + 0.2 * normal(cameras, 3, 3))[0]
    viewmats = torch.zeros(cameras, 4, 4, dtype=torch.float64)
    viewmats[:, :3, :3] = turn * turn.diagonal(dim1=1, dim2=2).sign()[:, None, :]
    viewmats[:, :3, 3] = 0.1 * normal(cameras, 3) + torch.tensor([0.0, 0.0, 2.0])
    viewmats[:, 3, 3] = 1.0
    focal = 0.9 * max(width, height)
    K = torch.tensor([[focal, 0, width / 2 + 1.3], [0, 1.1 * focal, height / 2 - 0.7], [0, 0, 1.0]])
    arguments = {
        "means": 2.4 * uniform(count, 3) - 1.2,
        "quats": normal(count, 4),
        "scales": torch.exp(0.8 * normal(count, 3) - 3.2),
        "opacities": uniform(count),
        "colors": uniform(count, 3),
        "viewmats": viewmats,
        "Ks": K.double().repeat(cameras, 1, 1),
        "backgrounds": uniform(cameras, 3),
    }
    rounded = {name: tensor.float().double() for name, tensor in arguments.items()}
    return HardScene(rounded, width, height)


def assert_exact(scene: HardScene, image: float = IMAGE, gradient: float = GRADIENT) -> None:
    """The CPU backend draws and differentiates the scene as the reference does."""
    clear = clear_pixels(scene)
    truth = draw(scene, "reference", torch.float64, clear)
    drawing = draw(scene, "numba", torch.float32, clear)
    mask = clear.unsqueeze(-1)
    assert clear.mean() > 0.99
    assert difference(drawing.image * mask, truth.image * mask) < image
    assert difference(drawing.alpha * mask, truth.alpha * mask) < image
    for name, expected in truth.gradients.items():
        assert difference(drawing.gradients[name], expected) < gradient, name


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("width", "height"), [(64, 48), (37, 53), (16, 16), (5, 90)])
def test_random_scenes_agree_with_float64(seed: int, width: int, height: int) -> None:
    assert_exact(random_scene(seed, 120, width, height, cameras=1 + seed % 3))


def test_a_crowded_scene_agrees_with_float64() -> None:
    assert_exact(random_scene(7, 1500, 70, 60))


def test_the_hand_at_full_resolution_agrees_with_float64() -> None:
    assert_exact(hand_scene(count=40, width=301, height=203, focal=450.0))


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 7])
def test_modes_and_channels_agree_with_float64(mode: str, antialiased: bool, channels: int) -> None:
    scene = random_scene(3, 80, 40, 35, cameras=2)
    generator = torch.Generator().manual_seed(0)
    results = []
    for backend, dtype in (("numba", torch.float32), ("reference", torch.float64)):
        generator.manual_seed(0)
        arguments = {name: value.to(dtype) for name, value in scene.arguments.items()}
        arguments["colors"] = torch.rand(2, 80, channels, generator=generator).to(dtype)
        arguments["backgrounds"] = torch.rand(channels, generator=generator).to(dtype)
        leaves = [value.requires_grad_() for name, value in arguments.items() if name != "Ks"]
        image, alpha, info = rasterize(
            **arguments,
            width=40,
            height=35,
            backend=backend,
            render_mode=mode,
            rasterize_mode="antialiased" if antialiased else "classic",
        )
        loss = (image * torch.rand(image.shape, generator=generator)).sum() + alpha.sum()
        gradients = torch.autograd.grad(loss, leaves, allow_unused=True)
        unused = [gradient is None for gradient in gradients]
        drawn = (image.detach(), alpha.detach())
        results.append((*drawn, gradients, unused, info["visible"].tolist()))
    (image, alpha, gradients, unused, visible), (image64, alpha64, truth, unused64, seen) = results
    assert image.shape[-1] == channels * ("RGB" in mode) + ("D" in mode)
    assert difference(image.double(), image64) < IMAGE
    assert difference(alpha.double(), alpha64) < IMAGE
    assert (unused, visible) == (unused64, seen)
    for gradient, expected in zip(gradients, truth, strict=True):
        if expected is not None:
            assert difference(gradient.double(), expected) < GRADIENT


@pytest.mark.parametrize("channels", [2, 16, 32, 33])
def test_many_channels_are_each_drawn_as_if_alone(channels: int) -> None:
    # Oracle: the same call with three channels at a time. Tolerance 1e-6.
    scene = random_scene(4, 60, 30, 20)
    arguments = {name: value.float() for name, value in scene.arguments.items()}
    del arguments["backgrounds"]
    arguments["colors"] = torch.rand(60, channels, generator=torch.Generator().manual_seed(1))
    image, _, _ = rasterize(**arguments, width=30, height=20)
    for first in range(0, channels, 3):
        arguments["colors"], whole = arguments["colors"][:, first : first + 3], arguments["colors"]
        some, _, _ = rasterize(**arguments, width=30, height=20)
        arguments["colors"] = whole
        torch.testing.assert_close(image[..., first : first + 3], some, atol=1e-6, rtol=1e-6)


def test_a_round_splat_on_the_axis_has_its_closed_form() -> None:
    # Oracle: alpha(r) = o exp(-r^2 / (2 (s^2 + 0.3))) with s = f sigma / z. Tolerance 1e-6.
    size, focal, z, sigma, opacity = 33, 100.0, 2.0, 0.06, 0.8
    image, alpha, info = rasterize(
        torch.tensor([[0.0, 0.0, z]]),
        torch.tensor([[0.3, -0.4, 0.5, 0.6]]),
        torch.full((1, 3), sigma),
        torch.tensor([opacity]),
        torch.tensor([[1.0, 0.5, 0.0]]),
        torch.eye(4)[None],
        torch.tensor([[[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]]]),
        size,
        size,
    )
    offset = torch.arange(size) + 0.5 - size / 2
    squared = offset[:, None] ** 2 + offset[None, :] ** 2
    variance = (focal * sigma / z) ** 2 + 0.3
    expected = opacity * torch.exp(-squared / (2 * variance))
    expected[expected < 1 / 255] = 0.0
    torch.testing.assert_close(alpha[0, :, :, 0], expected, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(image[0, :, :, 1], 0.5 * expected, atol=1e-6, rtol=1e-6)
    reach = math.ceil(math.sqrt(2 * math.log(255 * opacity) * variance))
    assert info["radii"][0, 0].tolist() == [reach, reach]
    assert info["means2d"][0, 0].tolist() == [size / 2, size / 2]


def test_reference_passes_gradcheck() -> None:
    scene = hand_scene(count=3, width=4, height=3, focal=8.0, seed=5)
    names = [name for name in scene.arguments if name != "Ks"]

    def image(*tensors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        colors, alphas, _ = rasterize(
            **dict(zip(names, tensors, strict=True)),
            Ks=scene.arguments["Ks"],
            width=4,
            height=3,
            backend="reference",
        )
        return colors, alphas

    leaves = [scene.arguments[name].clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-7, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 130))
def test_many_more_random_scenes_agree_with_float64(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    width, height, count = (
        int(torch.randint(1, n, (), generator=generator)) for n in (99, 99, 400)
    )
    assert_exact(random_scene(seed, count, width, height))
