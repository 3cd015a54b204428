"""PAO and the terms of the authors' code. Oracle: small numpy forms of their lines, of our own.

Their `train_single.py`, `train_multi.py` and `model_utils_mask_lr.py` work on float images, masks
and lists of regions, frame by frame. Tolerance 1e-5. Each line of `WITHOUT` leaves one of theirs
out and must be told apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from wildghand.dpd.dpd import DynamicPerturbation
from wildghand.gaussians.attributes import CHANNELS, SIZES
from wildghand.model import terms
from wildghand.pao.pao import PerturbationAwareWeights
from wildghand.pao.regions import Regions, overlapping, stack_regions

SIZE, T_B = 16, 1.7


def scene(frames: int = 2, seed: int = 0) -> dict[str, np.ndarray]:
    """Renderings, frames, hands and regions: a mesh that something covers, drawn mostly."""
    random = np.random.default_rng(seed)
    shape = (frames, SIZE, SIZE)
    silhouette = np.zeros(shape, bool)
    silhouette[:, 3:14, 2:13] = True
    visible = silhouette & (np.arange(SIZE) < 9)
    # A mask never ends just where the mesh does.
    visible[:, 5:7, 13:15] = True
    return {
        "image": random.uniform(size=(*shape, 3)),
        "drawing": random.uniform(size=(*shape, 3)),
        "coverage": np.where(silhouette, 1.0, 0.0) * random.uniform(0.93, 1.0, shape),
        "visible": visible,
        "silhouette": silhouette,
        "regions": random.uniform(size=(frames, 5, SIZE, SIZE)) < 0.6,
    }


def expected(given: dict[str, np.ndarray], **without: Any) -> np.ndarray:
    """Their `dis_mask`, (B, H, W); `without` leaves lines out."""
    residual = np.abs(given["drawing"] - given["image"])
    if "whole frame" in without:
        residual = np.abs(given["drawing"] - given["image"] * given["visible"][..., None])
    if "stretch" not in without:
        residual = (residual - residual.min()) / (residual.max() - residual.min())
    residual = residual.mean(axis=-1)
    found = np.zeros(residual.shape)
    for b, regions in enumerate(given["regions"]):
        mesh = given["visible" if "mesh" in without else "silhouette"][b]
        for region in regions:
            seen = region & mesh
            if not seen.any():
                continue
            error, share = residual[b][seen].mean(), seen.sum() / mesh.sum()
            found[b] += 100.0 * region * max(1.0 - error, 0.0) * max(share - 0.3, 0.0)
        if "covered" not in without:
            found[b][~given["visible"][b]] = 0.0
        mean = residual[b].sum() / given["visible"][b].sum()
        weight: Any = max(T_B - mean, 0.0)
        if "scalar" in without:
            weight = np.maximum(T_B - residual[b], 0.0)
        drawn = given["coverage"][b] >= (2.0 if "drawn" in without else 0.95)
        found[b] += np.where(drawn, 0.0, weight)
    return found


def module() -> PerturbationAwareWeights:
    made = PerturbationAwareWeights("released").double()
    with torch.no_grad():
        made.T_b.fill_(T_B)
    return made


def weighed(given: dict[str, np.ndarray], **changes: torch.Tensor) -> torch.Tensor:
    tensors = {name: torch.from_numpy(value) for name, value in given.items()} | changes
    residual = (tensors["drawing"] - tensors["image"]).abs()
    regions: Regions = stack_regions([overlapping(frame) for frame in given["regions"]])
    order = "visible", "silhouette", "coverage"
    return module().released(residual, regions, *(tensors[name] for name in order)).weights


@pytest.mark.parametrize("frames", [1, 2])
def test_weights_are_those_of_their_lines(frames: int) -> None:
    given = scene(frames)
    found = weighed(given).detach().numpy()
    np.testing.assert_allclose(found, expected(given), atol=1e-5)
    covered = given["silhouette"] & ~given["visible"] & (given["coverage"] >= 0.95)
    assert covered.sum() > 20
    assert (found[covered] == 0.0).all()


@pytest.mark.parametrize(
    "line", ["whole frame", "stretch", "mesh", "covered", "scalar", "drawn"], ids=str
)
def test_no_line_of_theirs_may_be_left_out(line: str) -> None:
    given = scene()
    away = np.abs(weighed(given).detach().numpy() - expected(given, **{line: True}))
    assert away.max() > 1e-2


def test_the_rendering_gets_the_gradient_of_their_lines() -> None:
    # Their residuals are not detached. Oracle: differences of the numpy form.
    given = scene(1, seed=3)
    drawing = torch.from_numpy(given["drawing"]).requires_grad_()
    weighed(given, drawing=drawing).mean().backward()
    assert drawing.grad is not None
    for place in ((0, 4, 4, 1), (0, 8, 6, 0), (0, 1, 1, 2), (0, 10, 12, 1)):
        means = []
        for step in (1e-6, -1e-6):
            moved = given["drawing"].copy()
            moved[place] += step
            means.append(expected({**given, "drawing": moved}).mean())
        slope = (means[0] - means[1]) / 2e-6
        assert float(drawing.grad[place]) == pytest.approx(slope, rel=1e-4, abs=1e-7)


def test_the_bias_term_is_the_square_of_the_sum_of_the_attributes_means() -> None:
    # `v_time` is varphi's output: before omega, and without what is dropped.
    torch.manual_seed(0)
    dpd = DynamicPerturbation(4, 8).double()
    raw = torch.rand(2, 30, CHANNELS, dtype=torch.float64)
    dpd.encoding = dpd.encoding.double()
    z = dpd.temporal(torch.tensor([0, 3])).z
    sums, start = np.zeros(2), 0
    for name, width in SIZES.items():
        layer = dpd.varphi[name]
        assert isinstance(layer, torch.nn.Linear)
        weight, bias = layer.weight.detach().numpy(), layer.bias.detach().numpy()
        for b in range(2):
            g = raw[b, :, start : start + width].numpy()
            seen = np.concatenate([g, np.tile(z[b].detach().numpy(), (30, 1))], axis=1)
            order = [*range(width, width + 8), *range(width)]  # z first here, g first there
            sums[b] += (seen[:, order] @ weight.T + bias).mean()
        start += width
    found = dpd.sum_of_means(raw, z).detach().numpy()
    np.testing.assert_allclose(found, sums, atol=1e-12)
    assert np.abs(sums).min() > 1e-3


def test_the_texture_term_is_of_squares_and_the_weights_are_theirs() -> None:
    left, right = (torch.rand(9, 4, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    squares = np.square(left.numpy() - right.numpy()).mean()
    assert float(terms.cross_hand(left, right, squared=True)) == pytest.approx(squares, rel=1e-6)
    theirs, paper = terms.WEIGHTS["released"], terms.WEIGHTS["paper"]
    assert (theirs.reconstruction, theirs.silhouette, theirs.weight_reward) == (100.0, 1.0, 0.5)
    assert (theirs.bias, theirs.shadow, theirs.opacity, theirs.cross_hand) == (0.1, 1e-3, 0.1, 0.1)
    rough = (theirs.laplacian_offsets, theirs.laplacian_scales, theirs.laplacian_colors)
    assert rough == (0.1, 0.1, 0.1)
    assert (theirs.squared_distances, theirs.squared_sums) == (True, True)
    # Eq. 8 has neither silhouette nor Laplacians of scales and colours, and norms, no squares.
    assert (paper.bias, paper.shadow, paper.opacity) == (0.1, 1e-3, 0.1)
    assert (paper.laplacian_offsets, paper.weight_reward) == (0.1, 0.5)
    assert (paper.silhouette, paper.laplacian_scales, paper.laplacian_colors) == (0.0, 0.0, 0.0)
    assert (paper.squared_distances, paper.squared_sums) == (False, False)
