"""The tables of an ablation. Oracles: golden text, made of scores with known effects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from made_results import made_results

from hwp_bench.analysis.pairing import MethodRuns
from hwp_bench.base.tables import Table, draw_table, format_table
from hwp_bench.evaluation.ablate.effects import (
    PRINTED,
    ablation_tables,
    base_text,
    cost_effects,
    score_effects,
)
from hwp_bench.evaluation.ablate.runs import AblationRuns, make_design
from hwp_bench.methods.manifest import read_manifest

MANIFEST = """
schema = "hwp-method/1"
training = "none"
name = "wild"
[entry]
python = "a:B"
[switches.dpd]
title = "DPD"
settings_off = {dpd = false}
[switches.pao]
title = "PAO"
settings_off = {pao = false}
[switches.prior]
settings_off = {prior = ""}
[switches.light]
settings_off = {light.on = false}
"""
#: dB that each variant has more than the barest, and seconds of its fit of 100 steps.
GAINS = {
    "no-dpd+no-pao": (0.0, 10.0), "no-dpd": (2.0, 11.0), "no-pao": (1.0, 15.0), "full": (4.0, 16.5)
}  # fmt: skip


@pytest.fixture
def ablation(tmp_path: Path) -> AblationRuns:
    (tmp_path / "method.toml").write_text(MANIFEST)
    runs = {}
    for variant, (gain, seconds) in GAINS.items():

        def score(c: int, f: int, s: int, gain: float = gain) -> float:
            return 20 + c + 0.1 * f + gain + 0.5 * s

        seeds = {s: made_results(variant, score, seed=s, seconds=seconds) for s in (0, 1)}
        runs[variant] = MethodRuns(variant, seeds)
    design = make_design(read_manifest(tmp_path))
    assert [variant.name for variant in design.variants] == list(GAINS)
    return AblationRuns(design, runs)


@pytest.fixture
def tables(ablation: AblationRuns) -> dict[str, Table]:
    effects = score_effects(ablation, ["psnr"], resamples=200)
    return ablation_tables(ablation, effects, cost_effects(ablation))


GOLDEN = r"""**Ablation**

| DPD | PAO | Single PSNR \[dB\] ↑ | Single Oriented distance ↓ | Interacting PSNR \[dB\] ↑ | Interacting Oriented distance ↓ | Macro PSNR \[dB\] ↑ | Macro Oriented distance ↓ | Time Step \[ms\] | Time Fit \[s\] | Failed frames |
| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
| – | – | 21.50 | 0.7850 | 22.50 | 0.7750 | 22.00 | 0.7800 | 100.0 | 10.0 | 0 |
| – | yes | <u>23.50</u> | <u>0.7650</u> | <u>24.50</u> | <u>0.7550</u> | <u>24.00</u> | <u>0.7600</u> | 110.0 | 11.0 | 0 |
| yes | – | 22.50 | 0.7750 | 23.50 | 0.7650 | 23.00 | 0.7700 | 150.0 | 15.0 | 0 |
| yes | yes | **25.50** | **0.7450** | **26.50** | **0.7350** | **26.00** | **0.7400** | 165.0 | 16.5 | 0 |

Base row: the method without DPD, PAO; keeps prior, light, as all rows do.

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


def test_scores_and_gains_by_perturbation_are_those_that_were_put_in(tables) -> None:
    heads = [column.name for column in tables["perturbations"].columns]
    for row, (gain, _) in zip(rows(tables["perturbations"]), GAINS.values(), strict=True):
        found = dict(zip(heads, row, strict=True))
        # Captures 0 and 1 change in their light, 2 and 3 are blurred: 20 + c + 0.25 + gain + 0.25.
        assert found["Illumination Variations PSNR [dB]"] == pytest.approx(21.0 + gain)
        assert found["Motion Blur PSNR [dB]"] == pytest.approx(23.0 + gain)
    heads = [column.name for column in tables["gains"].columns]
    for row, gain in zip(rows(tables["gains"]), (1.5, 2.5, 1.0), strict=True):
        found = dict(zip(heads, row, strict=True))
        for scope in ("Macro (4)", "Single (2)", "Motion Blur (2)"):
            assert [found[f"{scope} {name}"] for name in ("Gain", "Low", "High")] == (
                pytest.approx([gain] * 3)
            )


def test_what_is_printed_fits_two_screens(tables) -> None:
    # Two of 50 lines, 80 columns wide.
    text = "".join(draw_table(tables[name], 80) for name in PRINTED)
    assert len(text.splitlines()) <= 100
    assert max(map(len, text.splitlines())) <= 80


def test_the_base_row_says_what_it_keeps(ablation: AblationRuns) -> None:
    def changed(**settings: object) -> AblationRuns:
        runs = {
            name: MethodRuns(
                run.label,
                {
                    seed: replace(own, method=replace(own.method, settings=settings))
                    for seed, own in run.seeds.items()
                },
            )
            for name, run in ablation.runs.items()
        }
        return replace(ablation, runs=runs, settings=settings)

    # What a setting takes out of all rows is not kept.
    assert base_text(changed(light={"on": False})) == (
        "Base row: the method without DPD, PAO; keeps prior, as all rows do; set in all rows: "
        "light.on=False."
    )
    assert "keeps no other component" in base_text(changed(**{"light.on": False, "prior": ""}))


def test_costs_are_those_that_were_put_in(tables) -> None:
    found = {(row[0], row[1]): row for row in rows(tables["component_cost"])}
    assert found["DPD", "optimizer step"][4] == pytest.approx(50)
    assert found["PAO", "optimizer step"][4] == pytest.approx(10)
    assert found["PAO", "whole fit"][2] == pytest.approx(1000 * (11 * 16.5) ** 0.5)
    assert found["DPD", "rendered frame"][4] == pytest.approx(0)


def test_the_spread_over_seeds_is_a_standard_deviation(tables) -> None:
    assert rows(tables["seeds"])[0][1] == pytest.approx(0.5 / 2**0.5)
