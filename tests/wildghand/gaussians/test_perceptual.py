"""Perceptual distances. Oracles: order of distortions; VGG-19 written out with random weights."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from hwp_bench.base.errors import BadInput, ShapeMismatch
from wildghand.gaussians.perceptual import FilterBankLoss, Vgg19

SIZES = (64, 64, 128, 128, 256, 256, 256, 256, 512, 512, 512, 512, 512)
PLACES = (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28)


def picture(size: int = 64) -> torch.Tensor:
    """Smooth stripes and a disc."""
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    stripes = 0.5 + 0.3 * torch.sin(rows / 3.0)
    disc = ((rows - 30) ** 2 + (columns - 30) ** 2 < 200).float()
    return torch.stack([stripes, 0.5 * stripes + 0.4 * disc, disc], dim=-1)[None].float()


def test_equal_images_have_no_distance_and_weights_hide() -> None:
    image, other = picture(), picture().flip(1)
    ones = torch.ones(1, 64, 64)
    bank = FilterBankLoss()
    assert float(bank(image, image, ones)) == 0.0
    assert float(bank(image, other, 0.0 * ones)) == 0.0
    assert float(bank(image, other, ones)) > 0.01
    assert not list(bank.parameters())
    assert not bank.state_dict()


def test_a_shift_costs_less_than_a_blur_that_l1_prefers() -> None:
    random = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(0))
    texture = torch.nn.functional.avg_pool2d(random.permute(0, 3, 1, 2), 3, 1, 1)
    blurred = torch.nn.functional.avg_pool2d(texture, 9, 1, 4).permute(0, 2, 3, 1)
    texture = texture.permute(0, 2, 3, 1)
    shifted = texture.roll(1, dims=2)
    ones = torch.ones(1, 64, 64)
    bank = FilterBankLoss()
    l1 = [(other - texture).abs().mean() for other in (shifted, blurred)]
    distances = [float(bank(other, texture, ones)) for other in (shifted, blurred)]
    assert distances[0] / distances[1] < 0.9 * float(l1[0] / l1[1])


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (2, 2), (5, 3), (17, 33)])
def test_any_size_works(shape: tuple[int, int]) -> None:
    image = torch.rand(1, *shape, 3, requires_grad=True)
    distance = FilterBankLoss()(image, torch.zeros(1, *shape, 3), torch.ones(1, *shape))
    distance.backward()
    assert distance.isfinite()
    assert image.grad.isfinite().all()
    with pytest.raises(ShapeMismatch, match="weights"):
        FilterBankLoss()(image, image, torch.ones(2, *shape))


@pytest.fixture(scope="module")
def vgg_weights() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    weights, before = {}, 3
    for place, channels in zip(PLACES, SIZES, strict=True):
        shape = (channels, before, 3, 3)
        weights[f"features.{place}.weight"] = torch.randn(shape, generator=generator) / (
            3.0 * before**0.5
        )
        weights[f"features.{place}.bias"] = 0.1 * torch.randn(channels, generator=generator)
        before = channels
    return weights


@pytest.mark.slow
def test_vgg_is_configuration_e(vgg_weights: dict[str, torch.Tensor], tmp_path: Path) -> None:
    save_file(vgg_weights, tmp_path / "vgg.safetensors")
    torch.save(vgg_weights, tmp_path / "vgg.pth")
    modules: list[torch.nn.Module] = []
    before, slices = 3, []
    for count, channels in ((2, 64), (2, 128), (4, 256), (4, 512), (1, 512)):
        for _ in range(count):
            modules += [torch.nn.Conv2d(before, channels, 3, padding=1), torch.nn.ReLU()]
            before = channels
        modules.append(torch.nn.MaxPool2d(2))
    network = torch.nn.Sequential(*modules)
    network.load_state_dict({name[9:]: value for name, value in vgg_weights.items()})
    slices = [6, 11, 20, 29]  # behind relu2_1, relu3_1, relu4_1, relu5_1
    image, target = picture(32).requires_grad_(True), picture(32).flip(2)
    weights = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(1))
    mean = torch.tensor([0.485, 0.456, 0.406])
    std = torch.tensor([0.229, 0.224, 0.225])
    expected = 0.0
    responses = [
        ((shown.detach() * weights[..., None] - mean) / std).permute(0, 3, 1, 2)
        for shown in (image, target)
    ]
    factors = dict(zip(slices, (1 / 16, 1 / 8, 1 / 4, 1.0), strict=True))
    with torch.no_grad():
        for place, module in enumerate(network):
            responses = [module(response) for response in responses]
            if place in factors:
                expected += factors[place] * float((responses[0] - responses[1]).abs().mean())
    for name in ("vgg.safetensors", "vgg.pth"):
        vgg = Vgg19(tmp_path / name)
        distance = vgg(image, target, weights)
        assert float(distance.detach()) == pytest.approx(expected, rel=1e-4)
    distance.backward()
    assert image.grad.abs().max() > 0.0
    assert not any(parameter.requires_grad for parameter in vgg.parameters())


def test_what_is_no_vgg_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="does not exist"):
        Vgg19(tmp_path / "none.pth")
    for name in ("a.pth", "a.safetensors"):
        (tmp_path / name).write_bytes(b"no weights")
        with pytest.raises(BadInput, match="cannot be read"):
            Vgg19(tmp_path / name)
    save_file({"features.0.weight": torch.zeros(64, 3, 5, 5)}, tmp_path / "b.safetensors")
    with pytest.raises(BadInput, match=r"features\.0\.weight"):
        Vgg19(tmp_path / "b.safetensors")
    torch.save([1, 2], tmp_path / "c.pth")
    with pytest.raises(BadInput, match="table"):
        Vgg19(tmp_path / "c.pth")
