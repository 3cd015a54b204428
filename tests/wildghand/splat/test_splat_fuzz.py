"""Random calls; oracles: the reference in float64, or a clear error. Tolerances 1e-4 and 1e-3."""

from __future__ import annotations

import math
import warnings
from typing import Any

import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from wildghand.splat import rasterize

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
DTYPES = (torch.float32, torch.float32, torch.float64, torch.float16, torch.bfloat16)
FUZZ = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


def restrided(tensor: torch.Tensor, how: str) -> torch.Tensor:
    """The same values in another memory layout."""
    if how == "transposed" and tensor.ndim > 1:
        return tensor.transpose(0, -1).contiguous().transpose(0, -1)
    if how == "sliced":
        wide = tensor.repeat_interleave(2, dim=0)
        return wide[::2]
    if how == "offset":
        flat = torch.cat((tensor.new_zeros(1), tensor.reshape(-1)))
        return flat[1:].reshape(tensor.shape)
    return tensor


@st.composite
def calls(draw: Any) -> tuple[dict[str, torch.Tensor], dict[str, Any], dict[str, bool]]:
    """Tensors, options, and which of the tensors want a gradient."""
    count = draw(st.sampled_from([0, 1, 5, 8, 9, 40]))
    channels = draw(st.sampled_from([1, 2, 3, 4, 6]))
    cameras = draw(st.integers(1, 3))
    batch = draw(st.sampled_from([(), (), (1,), (2,), (2, 1)]))
    paired = draw(st.booleans()) and len(batch) == 1
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**20)))

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator)

    def shared_or(*tail: int) -> tuple[int, ...]:
        return tail if draw(st.booleans()) else (*batch, *tail)

    image_dims = batch if paired else (*batch, cameras)
    colors_of_cameras = draw(st.booleans()) and not paired
    viewmats = torch.eye(4).expand(*image_dims, 4, 4).clone()
    viewmats[..., :3, 3] = 0.1 * uniform(*image_dims, 3) + torch.tensor([0.0, 0.0, 1.5])
    width, height = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    K = torch.tensor([[30.0, 0, width / 2], [0, 33.0, height / 2], [0, 0, 1]])
    tensors = {
        "means": 2 * uniform(*batch, count, 3) - 1,
        "quats": 2 * uniform(*shared_or(count, 4)) - 1,
        "scales": 0.02 + 0.2 * uniform(*shared_or(count, 3)),
        "opacities": uniform(*shared_or(count)),
        "colors": uniform(*((*batch, cameras) if colors_of_cameras else batch), count, channels),
        "viewmats": viewmats,
        "Ks": K.expand(*image_dims, 3, 3).clone(),
    }
    if draw(st.booleans()):
        tensors["backgrounds"] = uniform(*(image_dims if draw(st.booleans()) else ()), channels)
    for name, tensor in tensors.items():
        tensor = restrided(tensor, draw(st.sampled_from(["", "transposed", "sliced", "offset"])))
        tensors[name] = tensor.to(draw(st.sampled_from(DTYPES)))
    options = {
        "width": width,
        "height": height,
        "render_mode": draw(st.sampled_from(["RGB", "RGB", "D", "ED", "RGB+D", "RGB+ED"])),
        "rasterize_mode": draw(st.sampled_from(["classic", "antialiased"])),
    }
    return tensors, options, {name: draw(st.booleans()) for name in tensors}


@FUZZ
@given(calls())
def test_any_valid_call_agrees_with_the_reference(
    call: tuple[dict[str, torch.Tensor], dict[str, Any], dict[str, bool]],
) -> None:
    tensors, options, wants = call
    results = []
    for backend in ("numba", "reference"):
        leaves = {}
        for name, tensor in tensors.items():
            leaf = tensor.double() if backend == "reference" else tensor
            leaves[name] = leaf.detach().requires_grad_(wants[name])
        image, alpha, info = rasterize(**leaves, **options, backend=backend)
        loss = image.square().sum() + alpha.sum()
        if loss.requires_grad:
            loss.backward()
        grads = {name: leaf.grad for name, leaf in leaves.items()}
        results.append((image.detach(), alpha.detach(), grads, info))
    (image, alpha, grads, info), (image64, alpha64, grads64, info64) = results
    assert image.shape == image64.shape
    if bool((info64["margin"] > 1e-4).all()):
        torch.testing.assert_close(image.double(), image64, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(alpha.double(), alpha64, atol=1e-4, rtol=1e-4)
        for name, truth in grads64.items():
            if truth is None or name == "Ks":
                continue
            got = grads[name]
            assert got is not None, name
            assert got.dtype == tensors[name].dtype
            exact = got.dtype in (torch.float32, torch.float64)
            bound = (1e-3 if exact else 2e-2) * max(1.0, float(truth.norm()))
            assert float((got.double() - truth).norm()) <= bound, name
    assert info["means2d"].shape == info64["means2d"].shape


VALUES = st.sampled_from(
    [0.0, -1.0, 1e-45, 1e-38, 1e-20, 1e-3, 0.5, 1.0, 1e3, 1e15, 1e20, 3.4e38, -3.4e38, math.inf,
     -math.inf, math.nan]
)  # fmt: skip


@FUZZ
@given(st.data())
def test_no_value_makes_anything_but_finite_numbers(data: st.DataObject) -> None:
    count = 10
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 1000)))
    shapes = {
        "means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,),
        "colors": (count, 3), "viewmats": (1, 4, 4), "Ks": (1, 3, 3), "backgrounds": (1, 3),
    }  # fmt: skip
    tensors = {name: torch.rand(shape, generator=generator) for name, shape in shapes.items()}
    tensors["viewmats"] = torch.eye(4)[None].clone()
    tensors["Ks"] = torch.tensor([[[20.0, 0, 10], [0, 20, 8], [0, 0, 1]]])
    for _ in range(data.draw(st.integers(1, 6))):
        name = data.draw(st.sampled_from(NAMES))
        flat = tensors[name].view(-1)
        flat[data.draw(st.integers(0, flat.numel() - 1))] = data.draw(VALUES)
    if data.draw(st.integers(0, 3)) == 0:
        tensors[data.draw(st.sampled_from(NAMES[:5]))].fill_(data.draw(VALUES))
    leaves = {name: tensor.requires_grad_() for name, tensor in tensors.items()}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "rasterize: ")
        image, alpha, _ = rasterize(
            **leaves, width=20, height=17, near_plane=data.draw(st.sampled_from([0.0, 0.01])),
            eps2d=data.draw(st.sampled_from([0.0, 0.3])),
            rasterize_mode=data.draw(st.sampled_from(["classic", "antialiased"])),
        )  # fmt: skip
    assert image.isfinite().all()
    assert alpha.isfinite().all()
    (image.sum() + alpha.sum()).backward()
    for name, leaf in leaves.items():
        if name != "Ks":
            assert leaf.grad is not None
            assert leaf.grad.isfinite().all(), name
