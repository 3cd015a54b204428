"""The page of the ablation study. Oracle: made result files, whose effects are sums by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from made_results import made_results

from benchmarks.ablation import PARTS, Study, command_of, main, read_part, write_page
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import write_json
from hwp_bench.evaluation.ablate.runs import make_design, result_folder
from hwp_bench.methods.manifest import find_method, read_manifest
from hwp_bench.results import write_results

#: What each component brings, dB.
GAINS = {"dpd": 1.0, "pao": 0.5, "prepass": 2.0}
STUDY = Study(("smoke",), ("cross", "paper"), 2, 16.0, None, starts=("abc, 2026-01-01",))


def fill(folder: Path, part: str, seeds: dict[int, int]) -> None:
    """Write the results of a part: captures by seed. The score is additive: 20 dB and the gains."""
    components, base, _ = PARTS[part]
    design = make_design(read_manifest(find_method("wildghand")), (), components, base)
    for seed, captures in seeds.items():
        for variant in design.variants:
            value = 20.0 + sum(GAINS[name] for name in components if name not in variant.thrown)
            made = made_results(
                "wildghand",
                lambda c, f, s, value=value: value + c + 0.02 * f,
                seed=seed,
                captures=captures,
            )
            title = f"WildGHand {variant.title}".strip()
            made = replace(made, method=replace(made.method, title=title))
            place = folder / "smoke" / part / result_folder(variant.name, seed)
            place.mkdir(parents=True)
            write_results(place / "results.json", made)


def page_of(folder: Path) -> str:
    page = folder / "docs" / "ablation.md"
    write_page(folder, page, page.parent / "pictures" / "ablation", STUDY)
    return page.read_text()


def test_the_page_has_the_numbers_of_the_result_files(tmp_path: Path) -> None:
    fill(tmp_path, "cross", {0: 2, 1: 2})
    fill(tmp_path, "paper", {0: 2, 1: 2})
    page = page_of(tmp_path)
    # Means: 20 dB, half a dB over captures and 0.05 over frames, and what the components bring.
    assert "**smoke, cross** (16 s a fit): 24.05 dB with all components, 20.55 dB" in page
    assert "DPD +1.00" in page
    assert "Pre-pass +2.00" in page
    assert "| smoke | paper | 16 s | 20.55 | 21.55 | 21.05 | 22.05 |" in page
    assert "| least | 23.55 | 1.00 | 0.50 | 2.00 |" in page
    assert "All seeds and captures that were asked for are in." in page
    assert "Base row: paper without DPD, PAO; keeps heads, prior, as all rows do." in page
    assert "| Fits | 48 |" in page
    assert command_of(STUDY) in page
    for part in ("cross", "paper"):
        assert f"(pictures/ablation/smoke-{part}.png)" in page
        assert (tmp_path / f"docs/pictures/ablation/smoke-{part}.png").stat().st_size > 10_000


def test_what_is_not_there_is_said_and_not_counted(tmp_path: Path) -> None:
    # The second seed was stopped after one capture; of the mode `paper` nothing was run.
    fill(tmp_path, "cross", {0: 2, 1: 1})
    part = read_part(tmp_path, STUDY, "smoke", "cross")
    assert part.ablation is not None
    assert list(part.ablation.any_run.seeds) == [0]
    page = page_of(tmp_path)
    assert "**The study is incomplete.**" in page
    assert "- smoke, cross: seed 1: 1 of 2 captures in all variants." in page
    assert "seed 1: 0 of 2 captures in all variants. Nothing of this part is shown." in page
    assert "Seeds: 0. " in page
    assert "Nothing of these modes is there." in page


def test_a_seed_that_is_not_whole_counts_where_there_is_no_other(tmp_path: Path) -> None:
    fill(tmp_path, "cross", {0: 1})
    page = page_of(tmp_path)
    assert "Captures: capture0. Seeds: 0." in page
    assert "**Incomplete**: seed 0: 1 of 2 captures in all variants" in page
    # A variant that lacks altogether: nothing can be compared.
    lacking = tmp_path / "smoke" / "cross" / result_folder("full", 0) / "results.json"
    lacking.unlink()
    with pytest.raises(UsageError, match="holds no result"):
        page_of(tmp_path)


def test_the_command_takes_a_study_as_it_was_asked_for(tmp_path: Path, capsys) -> None:
    fill(tmp_path, "cross", {0: 2})
    write_json(tmp_path / "study.json", {**vars(STUDY), "parts": ["cross"], "seeds": 1})
    main([str(tmp_path), "--page-only", "--seeds", "7"])
    assert "--parts cross --seeds 1 --budget 16" in (tmp_path / "page.md").read_text()
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--budget", "3", "--steps", "4"])
    assert "give one of them" in capsys.readouterr().err
