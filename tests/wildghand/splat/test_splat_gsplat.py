"""The CUDA backend.

Without a GPU: what is handed to `gsplat.rasterization` and what comes back, against a stand-in
that draws with the float64 reference (oracle), under the shapes that gsplat asserts. With
one: gsplat itself against the reference, tolerance 1e-4.
"""

from __future__ import annotations

import math
import sys
import types
from typing import Any

import pytest
import torch

from hwp_bench.base.errors import MissingDependency
from wildghand.gaussians.fit_loop import choose_device
from wildghand.splat import gsplat_backend, rasterize
from wildghand.splat.hard_cases import difference, draw, hand_scene
from wildghand.splat.scene import Options, flatten

HAS_GPU = choose_device("auto").type == "cuda"


class StandIn(types.ModuleType):
    """Like gsplat: asserts its documented shapes, draws by the reference."""

    def __init__(self, version: str) -> None:
        super().__init__("gsplat")
        self.__version__ = version
        self.calls: list[dict[str, Any]] = []

    def rasterization(
        self,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        colors: torch.Tensor,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        width: int,
        height: int,
        near_plane: float = 0.01,
        far_plane: float = 1e10,
        eps2d: float = 0.3,
        packed: bool = True,
        backgrounds: torch.Tensor | None = None,
        render_mode: str = "RGB",
        rasterize_mode: str = "classic",
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
        assert not packed
        batch, count, cameras = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
        assert quats.shape == (*batch, count, 4)
        assert scales.shape == (*batch, count, 3)
        assert opacities.shape == (*batch, count)
        assert colors.shape[:-1] in ((*batch, count), (*batch, cameras, count))
        assert viewmats.shape == (*batch, cameras, 4, 4)
        assert Ks.shape == (*batch, cameras, 3, 3)
        tensors = (means, quats, scales, opacities, colors, viewmats, Ks)
        for tensor in (*tensors, *([] if backgrounds is None else [backgrounds])):
            assert tensor.isfinite().all()
        assert quats.norm(dim=-1).min() > 0
        self.calls.append({"render_mode": render_mode, "near_plane": near_plane})
        image, alpha, info = rasterize(
            *tensors, width, height, near_plane=near_plane, far_plane=far_plane, eps2d=eps2d,
            backgrounds=backgrounds, render_mode=render_mode, rasterize_mode=rasterize_mode,
            backend="reference",
        )  # fmt: skip
        return image, alpha, info


def through(
    monkeypatch: pytest.MonkeyPatch, version: str, tensors: dict[str, torch.Tensor], **options: Any
) -> tuple[StandIn, torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Draws by the gsplat backend and the stand-in, on the CPU."""
    module = StandIn(version)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    settings = {
        "width": 40, "height": 30, "near_plane": 0.01, "far_plane": 1e10, "eps2d": 0.3,
        "render_mode": "RGB", "antialiased": False, "count_pairs": False, **options,
    }  # fmt: skip
    rest = {name: value for name, value in tensors.items() if name != "backgrounds"}
    scene = flatten(rest, tensors.get("backgrounds"), Options(**settings))
    image, alpha, info = gsplat_backend.rasterize_gsplat(scene)
    dims = scene.image_dims
    return module, image.reshape(*dims, 30, 40, -1), alpha.reshape(*dims, 30, 40, 1), info


VARIANTS = ["one set", "sets", "paired", "shared scales", "colours of cameras", "no background"]


def variant(name: str) -> dict[str, torch.Tensor]:
    tensors = dict(hand_scene(cameras=2).arguments)
    per_gaussian = ("means", "quats", "scales", "opacities", "colors")
    if name == "sets":
        tensors = {key: torch.stack([value] * 3) for key, value in tensors.items()}
        tensors["means"] = tensors["means"] + torch.arange(3)[:, None, None] * 0.01
    elif name == "paired":
        for key in per_gaussian:
            tensors[key] = torch.stack([tensors[key], tensors[key].flip(0)])
    elif name == "shared scales":
        for key in ("means", "quats"):
            tensors[key] = torch.stack([tensors[key], tensors[key].flip(0)])
    elif name == "colours of cameras":
        tensors["colors"] = torch.stack([tensors["colors"], tensors["colors"].flip(0)])
    elif name == "no background":
        del tensors["backgrounds"]
    return tensors


@pytest.mark.parametrize("version", ["1.5.3", "1.6.0+pt27cu128"])
@pytest.mark.parametrize("name", VARIANTS)
def test_arguments_are_mapped(monkeypatch: pytest.MonkeyPatch, version: str, name: str) -> None:
    tensors = variant(name)
    module, image, alpha, info = through(monkeypatch, version, tensors)
    expected, expected_alpha, truth = rasterize(**tensors, width=40, height=30, backend="reference")
    torch.testing.assert_close(image, expected)
    torch.testing.assert_close(alpha, expected_alpha)
    for key in ("means2d", "depths", "radii", "visible"):
        torch.testing.assert_close(info[key], truth[key])
    assert len(module.calls) == 1


@pytest.mark.parametrize("mode", ["D", "ED", "RGB+D", "RGB+ED"])
def test_modes_are_gsplats_own(monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    tensors = variant("one set")
    module, image, _, _ = through(
        monkeypatch, "1.5.3", tensors, render_mode=mode, antialiased=True, near_plane=0.0
    )
    expected, _, _ = rasterize(
        **tensors, width=40, height=30, backend="reference", render_mode=mode,
        rasterize_mode="antialiased",
    )  # fmt: skip
    torch.testing.assert_close(image, expected)
    assert module.calls == [{"render_mode": mode, "near_plane": 1e-6}]


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30, 0.0])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
@pytest.mark.parametrize("kind", ["one set", "sets", "colours of cameras"])
def test_what_gsplat_cannot_take_is_made_invisible(
    monkeypatch: pytest.MonkeyPatch, name: str, bad: float, kind: str
) -> None:
    tensors = variant(kind)
    tensors[name] = tensors[name].clone()
    tensors[name].view(-1, *tensors[name].shape[-1 if name == "opacities" else -2 :])[0, 7] = bad
    leaves = {key: value.clone().requires_grad_() for key, value in tensors.items()}
    _, image, _, _ = through(monkeypatch, "1.5.3", leaves)
    image.sum().backward()
    assert image.isfinite().all()
    assert all(leaf.grad is None or leaf.grad.isfinite().all() for leaf in leaves.values())
    if bad == 1e30 and name == "opacities":
        return  # an opacity above one is drawn as one
    expected, _, _ = rasterize(
        **{key: value.detach() for key, value in tensors.items()}, width=40, height=30,
        backend="reference",
    )  # fmt: skip
    if not (bad == 1e30 and name == "scales"):  # gsplat's float32 is narrower there
        torch.testing.assert_close(image.detach(), expected)


@pytest.mark.parametrize("name", ["viewmats", "Ks", "backgrounds"])
def test_a_bad_camera_sees_nothing(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    tensors = variant("one set")
    tensors[name] = tensors[name].clone()
    tensors[name][1].view(-1)[0] = math.nan
    _, image, _, _ = through(monkeypatch, "1.5.3", tensors)
    expected, _, _ = rasterize(**variant("one set"), width=40, height=30, backend="reference")
    torch.testing.assert_close(image[0], expected[0])
    assert image.isfinite().all()
    if name != "backgrounds":
        torch.testing.assert_close(image[1], tensors["backgrounds"][1].expand(30, 40, 3))


def test_no_gaussians_are_not_handed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    tensors = variant("one set")
    for name in ("means", "quats", "scales", "opacities", "colors"):
        tensors[name] = tensors[name][:0]
    module, image, alpha, info = through(monkeypatch, "1.5.3", tensors, render_mode="RGB+D")
    assert module.calls == []
    expected = torch.cat((tensors["backgrounds"], torch.zeros(2, 1)), -1)
    torch.testing.assert_close(image, expected[:, None, None].expand(2, 30, 40, 4))
    assert alpha.abs().max() == 0
    assert info["means2d"].shape == (2, 0, 2)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30])
def test_a_bad_background_is_black_without_gaussians(
    monkeypatch: pytest.MonkeyPatch, bad: float
) -> None:
    """On a GPU nobody has made it black before the reference draws it."""
    tensors = variant("one set")
    for name in ("means", "quats", "scales", "opacities", "colors"):
        tensors[name] = tensors[name][:0]
    expected = tensors["backgrounds"].clone()
    tensors["backgrounds"] = expected.clone()
    tensors["backgrounds"][0, 1] = bad
    expected[0, 1] = 0.0
    _, image, _, _ = through(monkeypatch, "1.5.3", tensors)
    torch.testing.assert_close(image, expected[:, None, None].expand(2, 30, 40, 3))


def test_an_old_or_missing_gsplat_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", StandIn("1.4.0"))
    with pytest.raises(MissingDependency, match=r"1\.4\.0, and the CUDA backend needs"):
        gsplat_backend._gsplat()
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(MissingDependency, match="pip install gsplat"):
        gsplat_backend._gsplat()


@pytest.mark.skipif(not HAS_GPU, reason="needs a CUDA GPU and gsplat")
@pytest.mark.parametrize("seed", range(5))
def test_gsplat_agrees_with_float64(seed: int) -> None:
    scene = hand_scene(count=300, width=90, height=70, cameras=2, seed=seed)
    truth = draw(scene, "reference", torch.float64)
    drawing = draw(scene, "gsplat", torch.float32)
    assert difference(drawing.image, truth.image) < 1e-4
    for name, expected in truth.gradients.items():
        assert difference(drawing.gradients[name], expected) < 1e-4, name


@pytest.mark.skipif(not HAS_GPU, reason="needs a CUDA GPU and gsplat")
def test_auto_takes_gsplat_for_cuda_tensors() -> None:
    tensors = {name: value.float().cuda() for name, value in hand_scene().arguments.items()}
    *_, info = rasterize(**tensors, width=40, height=30)
    assert info["backend"] == "gsplat"


def test_culled_gaussians_have_no_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """gsplat leaves their places and depths as its memory was."""
    drawn = StandIn.rasterization

    def dirty(self: StandIn, *args: Any, **options: Any) -> Any:
        image, alpha, info = drawn(self, *args, **options)
        culled = (info["radii"] == 0).any(-1)
        assert culled.any()
        info["means2d"] = info["means2d"].masked_fill(culled[..., None], math.nan)
        info["depths"] = info["depths"].masked_fill(culled, math.nan)
        return image, alpha, info

    monkeypatch.setattr(StandIn, "rasterization", dirty)
    tensors = variant("one set")
    tensors["means"] = tensors["means"].clone()
    tensors["means"][3, 2] = -5.0
    *_, info = through(monkeypatch, "1.5.3", tensors)
    *_, truth = rasterize(**tensors, width=40, height=30, backend="reference")
    for key in ("means2d", "depths"):
        torch.testing.assert_close(info[key], truth[key])
