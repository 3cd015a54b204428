"""The record of an ablation, `ablation.json`: what was run, where it lies, what it says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hwp_bench.base.files import write_json
from hwp_bench.base.tables import Table, to_object
from hwp_bench.evaluate.ablate.effects import CostEffect, ScoreEffect
from hwp_bench.evaluate.ablate.run import AblationRuns, result_folder
from hwp_bench.evaluate.ablate.tables import total_seconds
from hwp_bench.results.find import ABLATION, ABLATION_SCHEMA


def ablation_record(
    ablation: AblationRuns,
    effects: Sequence[ScoreEffect],
    costs: Sequence[CostEffect],
    tables: Mapping[str, Table],
) -> dict[str, Any]:
    """Return the JSON object of an ablation; paths are relative to its folder."""
    design = ablation.design
    first = ablation.results[0]
    switches = (*design.components, *design.alternatives)
    return {
        "schema": ABLATION_SCHEMA,
        "method": {"name": first.method.name, "digest": first.method.digest},
        "preset": first.method.preset,
        "suite": first.suite,
        "budget": first.budget,
        "frames": first.frames,
        "toolkit": first.toolkit,
        "environment": first.environment,
        "seeds": sorted(
            result.seed for result in next(iter(ablation.runs.values())).seeds.values()
        ),
        "captures": [
            {"id": c.id, "digest": c.digest, "split_digest": c.split_digest} for c in first.captures
        ],
        "switches": [asdict(item) for item in switches],
        "variants": [
            {
                **asdict(variant),
                "results": [
                    f"{result_folder(variant.name, seed)}/results.json"
                    for seed in ablation.runs[variant.name].seeds
                ],
            }
            for variant in design.variants
        ],
        "process_seconds": total_seconds(ablation.results),
        "score_effects": [asdict(item) for item in effects],
        "cost_effects": [asdict(item) for item in costs],
        "tables": {name: to_object(table) for name, table in tables.items()},
    }


def write_record(out: Path, record: Mapping[str, Any]) -> Path:
    """Write `ablation.json`."""
    return write_json(out / ABLATION, dict(record))
