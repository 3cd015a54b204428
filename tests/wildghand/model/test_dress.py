"""Gaussians in the world by compiled loops; oracle: the same in torch, float64; 1e-5."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from wildghand.dpd.dpd import DynamicPerturbation, FramePerturbation
from wildghand.gaussians.attributes import Activation, RawAttributes
from wildghand.gaussians.rig import AnchorPoses
from wildghand.model.dress import dress
from wildghand.network import NetworkOutput, Refinement

FRAMES, COUNT = 3, 700
ACTIVATION = Activation(max_offset=0.01)
KEPT = torch.tensor([True, False, True])
SHARES = torch.tensor([1.0, 0.4, 0.0])


class Scene:
    """Leaves of a random prediction in one type."""

    def __init__(self, dtype: torch.dtype, frames: int = FRAMES, count: int = COUNT) -> None:
        random = torch.Generator().manual_seed(0)

        def leaf(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=random).to(dtype).requires_grad_()

        self.raw, self.offsets, self.positions = (
            leaf(frames, count, 14),
            leaf(count, 3),
            leaf(frames, count, 3),
        )
        with torch.no_grad():
            # Some scales leave their limits on both sides, and a quaternion is almost zero.
            self.raw[..., 3:6] *= 3.0
            self.raw[0, 0, 6:10] *= 1e-6
        self.shadow = torch.rand(frames, count, 1, generator=random).to(dtype).requires_grad_()
        turns = torch.nn.functional.normalize(
            torch.randn(frames, count, 4, generator=random), dim=-1
        )
        self.orientations = turns.to(dtype)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            self.module = DynamicPerturbation(20, 16)
            torch.nn.init.normal_(self.module.psi.weight)
        self.module = self.module.to(dtype)
        self.frames = torch.arange(frames) + 3
        self.field = leaf(frames, count, 14)

    def dressed(
        self, *, biased: bool, kept: Tensor | None, shares: Tensor | None, field: bool = False
    ) -> list[Tensor]:
        none = torch.zeros(1, dtype=self.raw.dtype)
        prediction = NetworkOutput(
            RawAttributes.split(self.raw),
            self.shadow,
            self.offsets,
            Refinement(none.expand(len(self.raw), 1), none, none.expand(len(self.raw), 1)),
            none,
        )
        perturbation = None
        if biased:
            perturbation = FramePerturbation(
                self.module,
                self.module.temporal(self.frames),
                kept,
                self.field if field else None,
            )
        anchors = AnchorPoses(self.positions, self.orientations)
        made, size = dress(anchors, prediction, ACTIVATION, perturbation, shares)
        assert (size is None) == (not biased)
        tensors = [made.means, made.quats, made.scales, made.opacities, made.colors]
        return tensors if size is None else [*tensors, 1e3 * size]

    def gradients(self, made: list[Tensor]) -> dict[str, Tensor]:
        random = torch.Generator().manual_seed(2)
        total = torch.zeros((), dtype=self.raw.dtype)
        for tensor in made:
            total = total + (tensor * torch.randn(tensor.shape, generator=random).to(tensor)).sum()
        total.backward()
        leaves = {
            "raw": self.raw,
            "offsets": self.offsets,
            "positions": self.positions,
            "shadow": self.shadow,
            "field": self.field,
            **dict(self.module.named_parameters()),
        }
        return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


@pytest.mark.parametrize(("biased", "field"), [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("kept", [None, KEPT])
@pytest.mark.parametrize("shares", [None, SHARES])
def test_values_and_gradients(
    biased: bool, field: bool, kept: Tensor | None, shares: Tensor | None
) -> None:
    mine, true = Scene(torch.float32), Scene(torch.float64)
    made = mine.dressed(biased=biased, kept=kept, shares=shares, field=field)
    expected = true.dressed(biased=biased, kept=kept, shares=shares, field=field)
    for value, oracle in zip(made, expected, strict=True):
        torch.testing.assert_close(value.double(), oracle, rtol=1e-5, atol=1e-6)
    found, exact = mine.gradients(made), true.gradients(expected)
    assert found.keys() == exact.keys()
    assert ("field" in found) == field
    for name, oracle in exact.items():
        # The quaternion that is almost zero turns by a million times its gradient: by itself.
        parts = [(found[name].double(), oracle)]
        if name == "raw":
            parts = [(found[name][0, 0].double(), oracle[0, 0])]
            parts.append((found[name].flatten(0, 1)[1:].double(), oracle.flatten(0, 1)[1:]))
        for value, truth in parts:
            scale = float(truth.abs().max()) or 1.0
            torch.testing.assert_close(value / scale, truth / scale, rtol=0, atol=1e-5)


def test_a_frame_without_biases_passes_no_gradient_to_them() -> None:
    scene = Scene(torch.float32)
    made = scene.dressed(
        biased=True, kept=torch.zeros(FRAMES, dtype=torch.bool), shares=None, field=True
    )
    found = scene.gradients(made)
    assert float(made[-1].detach()) == 0.0
    assert all(
        not found[name].any() for name in found if name.startswith(("psi", "varphi", "field"))
    )


def test_threads_change_no_bit() -> None:
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            scene = Scene(torch.float32, frames=2, count=6_000)
            scene.frames = scene.frames[:2]
            made = scene.dressed(biased=True, kept=None, shares=SHARES[:2], field=True)
            found.append([*made, *scene.gradients(made).values()])
    finally:
        torch.set_num_threads(before)
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
