"""`wildghand info`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from typing import Any

_EXAMPLES = """examples:
  wildghand info
  wildghand info --json
  wildghand info --network paper

Draws a small scene with every rasterizer backend that this machine has and compares it with the
float64 reference. Exit status 0: every backend that is there is right; 1: one is not.
With --network it lists the parameters of the prediction network for two hands instead.
"""

#: Largest difference to the float64 reference, on colours in [0, 1], that counts as right.
TOLERANCE = 1e-4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "--network", choices=("compact", "paper"), help="list the parameters of the network"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    if args.network:
        _print_network(args.network, args.json)
        return 0
    from hwp_bench.base.tables import Column, Table, print_table
    from hwp_bench.results.schema import environment

    facts = environment()
    backends = [_check(name) for name in ("numba", "gsplat")]
    if args.json:
        json.dump({"environment": facts, "backends": backends}, sys.stdout, indent=1)
        print()
    else:
        rows = [(name, version) for name, version in facts.pop("packages").items()]
        rows = [*((name, str(value)) for name, value in facts.items()), *rows]
        print_table(Table("Environment", (Column("what"), Column("version")), tuple(rows)))
        columns = (Column("backend"), Column("state"), Column("largest error", 8))
        cells = tuple((b["backend"], b["state"], b["largest_error"]) for b in backends)
        print_table(Table("Rasterizer", columns, cells))
    return 1 if any(backend["state"] == "wrong" for backend in backends) else 0


def _print_network(size: str, as_json: bool) -> None:
    """List the parameters of one size of the network."""
    from hwp_bench.base.tables import Column, Table, print_table
    from wildghand.network.network import blank_network, parameter_table
    from wildghand.network.settings import network_settings

    settings = network_settings(size)
    rows = parameter_table(blank_network(settings))
    parts: dict[str, int] = {}
    for row in rows:
        parts[row.part] = parts.get(row.part, 0) + row.parameters
    total = sum(parts.values())
    if as_json:
        layers = [
            {**dataclasses.asdict(row), "part": row.part, "parameters": row.parameters}
            for row in rows
        ]
        facts = {"settings": settings.to_json(), "layers": layers, "parts": parts, "total": total}
        json.dump(facts, sys.stdout, indent=1)
        print()
        return
    columns = (
        Column("layer"),
        Column("weights"),
        Column("each"),
        Column("times"),
        Column("parameters"),
    )
    cells = [
        (row.layer, row.weights, f"{row.each:,}", row.times, f"{row.parameters:,}") for row in rows
    ]
    print_table(Table(f"Network {size!r}, two hands", columns, tuple(cells), ranked=False))
    sums = [(part, f"{count:,}") for part, count in [*parts.items(), ("total", total)]]
    print_table(Table("Parts", (Column("part"), Column("parameters")), tuple(sums), ranked=False))


def _check(backend: str) -> dict[str, Any]:
    """Draw a seeded scene and compare it with the reference."""
    import torch

    from hwp_bench.base.errors import HwpError
    from wildghand.splat import rasterize

    generator = torch.Generator().manual_seed(0)
    means = torch.rand(50, 3, generator=generator, dtype=torch.float64) - 0.5
    means[:, 2] += 2.0
    scene: dict[str, Any] = {
        "means": means,
        "quats": torch.randn(50, 4, generator=generator, dtype=torch.float64),
        "scales": 0.02 + 0.05 * torch.rand(50, 3, generator=generator, dtype=torch.float64),
        "opacities": torch.rand(50, generator=generator, dtype=torch.float64),
        "colors": torch.rand(50, 3, generator=generator, dtype=torch.float64),
        "viewmats": torch.eye(4, dtype=torch.float64)[None],
        "Ks": torch.tensor([[[60.0, 0, 24], [0, 60, 24], [0, 0, 1]]], dtype=torch.float64),
    }
    truth = rasterize(**scene, width=48, height=48, backend="reference")[0]
    device = "cuda" if backend == "gsplat" else "cpu"
    try:
        if device == "cuda" and not torch.cuda.is_available():
            return {"backend": backend, "state": "no CUDA device", "largest_error": None}
        moved = {name: value.float().to(device) for name, value in scene.items()}
        image = rasterize(**moved, width=48, height=48, backend=backend)[0]
    except HwpError as error:
        return {"backend": backend, "state": f"not there: {error}", "largest_error": None}
    largest = float((image.cpu().double() - truth).abs().max())
    state = "right" if largest <= TOLERANCE else "wrong"
    return {"backend": backend, "state": state, "largest_error": largest}
