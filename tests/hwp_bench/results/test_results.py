"""The result file: what is written is read, and what is edited badly is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hwp_bench.base.errors import BadInput, BadResult
from hwp_bench.results import read_results, write_results
from hwp_bench.results.schema import environment


def test_results_round_trip(make_results, tmp_path: Path) -> None:
    write_results(tmp_path / "results.json", make_results())
    assert read_results(tmp_path) == make_results()
    assert read_results(tmp_path / "results.json").metrics == ["psnr", "ssim"]


@pytest.mark.parametrize(
    ("path", "value", "problem"),
    [
        (["schema"], "other", "schema: is 'other' where 'hwp-results/1' is read"),
        (["seed"], "0", "seed: is '0', expected an integer"),
        (["seed"], None, "seed: is None, expected an integer"),
        (["extra"], 1, "extra: is not known"),
        (["captures", 0, "frames", 1, "frame"], 1.5, "captures[0].frames[1].frame: is 1.5"),
        (["captures", 0, "frames", 1, "scores", "psnr"], "x", "frames[1].scores.psnr"),
        (["captures", 0, "steps"], True, "captures[0].steps"),
        (["captures", 0, "curve"], {}, "captures[0].curve"),
        (["method"], [], "method: must be a table"),
    ],
)
def test_wrong_fields_are_named(make_results, tmp_path: Path, path, value, problem: str) -> None:
    file = write_results(tmp_path / "results.json", make_results())
    content = json.loads(file.read_text())
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    file.write_text(json.dumps(content))
    with pytest.raises(BadResult) as caught:
        read_results(file)
    assert problem in str(caught.value)


def test_missing_fields_and_files_are_named(make_results, tmp_path: Path) -> None:
    file = write_results(tmp_path / "results.json", make_results())
    content = json.loads(file.read_text())
    del content["captures"][0]["fit_seconds"]
    file.write_text(json.dumps(content))
    with pytest.raises(BadResult, match=r"captures\[0\]\.fit_seconds: is missing"):
        read_results(file)
    with pytest.raises(BadInput, match="does not exist"):
        read_results(tmp_path / "nowhere")


def test_a_field_with_a_default_may_be_missing(make_results, tmp_path: Path) -> None:
    results = make_results()
    file = write_results(tmp_path / "results.json", results)
    content = json.loads(file.read_text())
    del content["captures"][0]["job_seconds"]
    file.write_text(json.dumps(content))
    assert read_results(file) == results


def test_the_environment_names_versions_and_no_place() -> None:
    facts = environment()
    assert facts["packages"]["numpy"]
    assert facts["cores"] >= 1
    assert "/" not in json.dumps(facts["packages"])
