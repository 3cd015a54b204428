"""The tables of an ablation. Oracles: golden text, made of scores with known effects."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_results import made_results

from hwp_bench.analysis.pairing import MethodRuns
from hwp_bench.base.tables import Table, format_table
from hwp_bench.evaluation.ablate.effects import ablation_tables, cost_effects, score_effects
from hwp_bench.evaluation.ablate.runs import AblationRuns, make_design
from hwp_bench.methods.manifest import read_manifest

MANIFEST = """
schema = "hwp-method/1"
name = "wild"
[entry]
python = "a:B"
[switches.dpd]
title = "DPD"
settings_off = {dpd = false}
[switches.pao]
title = "PAO"
settings_off = {pao = false}
"""
#: dB that each variant has more than the barest, and seconds of its fit of 100 steps.
GAINS = {
    "no-dpd+no-pao": (0.0, 10.0), "no-dpd": (2.0, 11.0), "no-pao": (1.0, 15.0), "full": (4.0, 16.5)
}  # fmt: skip


@pytest.fixture
def tables(tmp_path: Path) -> dict[str, Table]:
    (tmp_path / "method.toml").write_text(MANIFEST)
    runs = {}
    for variant, (gain, seconds) in GAINS.items():

        def score(c: int, f: int, s: int, gain: float = gain) -> float:
            return 20 + c + 0.1 * f + gain + 0.5 * s

        seeds = {s: made_results(variant, score, seed=s, seconds=seconds) for s in (0, 1)}
        runs[variant] = MethodRuns(variant, seeds)
    design = make_design(read_manifest(tmp_path))
    assert [variant.name for variant in design.variants] == list(GAINS)
    ablation = AblationRuns(design, runs)
    effects = score_effects(ablation, ["psnr"], resamples=200)
    return ablation_tables(ablation, effects, cost_effects(ablation))


GOLDEN = r"""**Ablation**

| DPD | PAO | Single PSNR \[dB\] ↑ | Single Oriented distance ↓ | Interacting PSNR \[dB\] ↑ | Interacting Oriented distance ↓ | Macro PSNR \[dB\] ↑ | Macro Oriented distance ↓ | Time Step \[ms\] | Time Fit \[s\] | Failed frames |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
| – | – | 21.50 | 0.7850 | 22.50 | 0.7750 | 22.00 | 0.7800 | 100.0 | 10.0 | 0 |
| – | yes | <u>23.50</u> | <u>0.7650</u> | <u>24.50</u> | <u>0.7550</u> | <u>24.00</u> | <u>0.7600</u> | 110.0 | 11.0 | 0 |
| yes | – | 22.50 | 0.7750 | 23.50 | 0.7650 | 23.00 | 0.7700 | 150.0 | 15.0 | 0 |
| yes | yes | **25.50** | **0.7450** | **26.50** | **0.7350** | **26.00** | **0.7400** | 165.0 | 16.5 | 0 |

smoke: 4 captures, seeds 0, 1; protocol hwp-v1; means over captures of means over test frames, then over seeds. Step and fit: means over captures and seeds, on the method's own clock.
"""  # noqa: E501


def test_the_ablation_table_is_the_papers_with_its_cost(tables) -> None:
    assert format_table(tables["ablation"], "md") == GOLDEN


def rows(table: Table) -> list[tuple]:
    return list(table.rows)


def test_effects_are_those_that_were_put_in(tables) -> None:
    # (4 - 2 + 1 - 0) / 2, (4 - 1 + 2 - 0) / 2, 4 - 2 - 1 + 0: the same in every frame.
    macro = [row for row in rows(tables["effects"]) if row[3] == "Macro"]
    assert [row[0] for row in macro] == ["DPD", "PAO", "DPD x PAO"]
    assert [row[5] for row in macro] == pytest.approx([1.5, 2.5, 1.0])
    for row in macro:
        assert (row[6], row[7]) == (pytest.approx(row[5]), pytest.approx(row[5]))
        assert row[8] > 0.999
    perturbed = rows(tables["effects_perturbations"])
    assert len({row[3] for row in perturbed}) == 2
    assert len(perturbed) == 6


def test_costs_are_those_that_were_put_in(tables) -> None:
    found = {(row[0], row[1]): row for row in rows(tables["component_cost"])}
    assert found["DPD", "optimizer step"][4] == pytest.approx(50)
    assert found["PAO", "optimizer step"][4] == pytest.approx(10)
    assert found["PAO", "whole fit"][2] == pytest.approx(1000 * (11 * 16.5) ** 0.5)
    assert found["DPD", "rendered frame"][4] == pytest.approx(0)


def test_the_spread_over_seeds_is_a_standard_deviation(tables) -> None:
    assert rows(tables["seeds"])[0][1] == pytest.approx(0.5 / 2**0.5)
