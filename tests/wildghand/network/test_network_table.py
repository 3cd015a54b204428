"""Oracle: the paper size's parameters counted by hand from its dimensions; exact."""

from __future__ import annotations

import json

import pytest

from wildghand.cli.main import main
from wildghand.network.network import blank_network, parameter_table
from wildghand.network.settings import network_settings


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
    rows = parameter_table(blank_network(network_settings("paper")))
    assert {row.layer: row.parameters for row in rows} == wanted


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_the_table_leaves_nothing_out(size: str) -> None:
    network = blank_network(network_settings(size))
    assert all(parameter.is_meta for parameter in network.parameters())
    total = sum(parameter.numel() for parameter in network.parameters())
    assert sum(row.parameters for row in parameter_table(network)) == total


@pytest.mark.parametrize("size", ["compact", "paper"])
def test_the_command_prints_the_table(size: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--network", size, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["settings"]["size"] == size
    assert facts["total"] == sum(row["parameters"] for row in facts["layers"])
    assert facts["total"] == sum(facts["parts"].values())
    assert main(["info", "--network", size]) == 0
    assert f"{facts['total']:,}" in capsys.readouterr().out
