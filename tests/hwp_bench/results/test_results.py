"""The result file: what is written is read, and what is edited badly is named.

Runs without a sandbox are named on the console and below tables. Oracle: the made results.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from small_captures import results_example

from hwp_bench.analysis.cost import machine_notes
from hwp_bench.base.errors import BadInput, BadResult, MissingDependency
from hwp_bench.base.tables import to_markdown
from hwp_bench.evaluation.sentences import outcome_lines
from hwp_bench.report.tables import all_tables
from hwp_bench.results import FreeViewResult, Results, read_results, write_results
from hwp_bench.results.schema import add_isolation_note, environment, isolation_note, isolation_text


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


def _made(isolation: str | None, name: str = "plain") -> Results:
    results = results_example(name)
    captures = [replace(capture, isolation=isolation) for capture in results.captures]
    return replace(results, captures=captures)


def test_the_console_says_the_level_on_every_run(tmp_path: Path) -> None:
    clock = "2.0 s of fitting, by the method's clock; processes ran 4.0 s"
    lines = outcome_lines(tmp_path, _made("namespaces"))
    assert lines == [f"times: {clock}", "isolation: namespaces"]
    refused = _made("processes (new namespaces: No space)")
    times, line = outcome_lines(tmp_path, refused, "v, seed 0, ")
    assert times == f"times: v, seed 0, {clock}"
    assert line.startswith(
        "warning: v, seed 0, no isolation on capture2 (the system refuses them: "
        "new namespaces: No space). "
    )
    assert isolation_text(_made("processes")).startswith("warning: no isolation on capture2. ")
    assert isolation_text(_made(None)) == ""


@pytest.mark.parametrize("isolation", ["processes", "processes (mount of /usr: refused)"])
def test_every_table_names_methods_that_ran_without_walls(isolation: str) -> None:
    walled, bare = _made("namespaces", "honest"), _made(isolation, "bare")
    note = "Run without a sandbox, where test frames can be read: Bare."
    for table in all_tables([walled, bare]).values():
        assert table.notes.count(note) == 1
        assert note in to_markdown(table)
        assert add_isolation_note(table, [bare]) == table
    assert machine_notes([walled, bare])[-1] == note
    for kind in ("namespaces", None):
        assert isolation_note([_made(kind)]) == ""
        assert not any(
            "walls" in text for t in all_tables([_made(kind)]).values() for text in t.notes
        )


def test_results_become_tables_of_pandas(make_results) -> None:
    results = make_results()
    (capture,) = results.captures
    clip = FreeViewResult("d", capture.frames[:1], "p")
    results = replace(results, captures=[replace(capture, free_view=clip)])
    frames = results.to_frame()
    assert frames.columns.tolist() == [
        *("method", "suite", "seed", "capture", "frame", "psnr", "ssim", "failure")
    ]
    assert frames["frame"].tolist() == [18, 19]
    assert frames.groupby("capture")["psnr"].mean().to_dict() == {"capture2": 20.5}
    assert results.to_frame(free_view=True)["psnr"].tolist() == [20.0]
    assert make_results().to_frame(free_view=True).empty


def test_without_pandas_a_table_says_what_to_install(
    make_results, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingDependency, match=r"pip install 'hwp-bench\[pandas\]'"):
        make_results().to_frame()
