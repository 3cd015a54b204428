"""What methods learnt from before they see a capture. Oracles: the prior's record, the suites."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from made_entries import complete_results, with_keys
from small_methods import SUBMISSION, write_manifest

from hwp_bench.base.errors import BadMethod, BadResult, UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.base.packages import PACKAGES
from hwp_bench.cli.main import main
from hwp_bench.evaluation.evaluate import EvaluationSettings, evaluate
from hwp_bench.leaderboard.entries import make_entry, write_entry
from hwp_bench.leaderboard.rules import check_entries, check_names, sound_entries
from hwp_bench.methods.manifest import read_manifest, shipped_methods
from hwp_bench.results import Results, TrainingData, read_results, write_results
from hwp_bench.suites.suite import suite_scenes
from hwp_bench.taxonomy import SUITES
from tools.paint_skins import PEOPLE, people

CLEAN = 'training = "none"'


@pytest.mark.parametrize(
    ("said", "kinds", "text"),
    [
        (CLEAN, ("none",), "none"),
        (
            'training = {public = ["InterHand2.6M", "HanCo"]}',
            ("public",),
            "public data sets (InterHand2.6M, HanCo)",
        ),
        (
            f'training = {{simulated = {{quiet8 = ["{"a" * 64}"]}}, private = ["our scans"]}}',
            ("simulated", "private"),
            "simulated people (quiet8); private data (our scans)",
        ),
    ],
)
def test_a_manifest_declares_it(
    tmp_path: Path, said: str, kinds: tuple[str, ...], text: str
) -> None:
    file = write_manifest(tmp_path, "mine", SUBMISSION) / "method.toml"
    file.write_text(file.read_text().replace(CLEAN, said))
    found = read_manifest(tmp_path).training
    assert (found.kinds, found.text) == (kinds, text)


@pytest.mark.parametrize(
    ("said", "problem"),
    [
        ("", "training: does not say what the method was trained on"),
        ("training = {}", "training: does not say what the method was trained on"),
        ('training = "some"', "training: does not say what the method was trained on"),
        ("training = 3", "training: must be a table"),
        ('training = {simulated = {quiet8 = ["x"]}}', "training.simulated.quiet8.*'x'"),
        ('training = {secret = ["x"]}', "training.secret: is not known"),
    ],
)
def test_a_method_that_does_not_declare_it_is_refused(
    tmp_path: Path, said: str, problem: str
) -> None:
    file = write_manifest(tmp_path, "mine", SUBMISSION) / "method.toml"
    file.write_text(file.read_text().replace(CLEAN, said))
    with pytest.raises(BadMethod, match=problem):
        read_manifest(tmp_path)


def test_methods_that_ship_declare_what_their_files_are_of() -> None:
    """The prior's own record and the painter of the skins; all others start from nothing."""
    record = json.loads((PACKAGES / "wildghand/priors/compact/prior.json").read_text("utf-8"))
    sources = [capture["source"] for capture in record["captures"]]
    prior: dict[str, list[str]] = {}
    for source in sources:
        prior.setdefault(source["scene"], []).append(source["scene_digest"])
    space = [sha256_json([asdict(person) for person in people(PEOPLE)])]
    painted = {"painted-people-700000-to-700239": space}
    wanted: Mapping[str, Any] = {
        "wildghand": {name: sorted(own) for name, own in prior.items()},
        "one-shot-prior": {name: sorted(own) for name, own in prior.items()},
        "texture-space": painted,
    }
    for manifest in shipped_methods():
        declared = TrainingData(simulated=wanted.get(manifest.name, {}))
        assert manifest.training == declared, manifest.name


@pytest.mark.parametrize("name", SUITES)
def test_no_method_that_ships_learnt_from_a_suite(name: str) -> None:
    scenes = suite_scenes(name)
    assert scenes
    for manifest in shipped_methods():
        assert manifest.training.shared(scenes) == [], manifest.name


def learnt(training: TrainingData, name: str = "mine") -> Results:
    results = complete_results(name)
    return with_keys(replace(results, method=replace(results.method, training=training)))


@pytest.mark.parametrize(
    "training",
    [
        # Under another name, by its digest; with another person, by its name; as a data set.
        TrainingData(simulated={"mine": [suite_scenes("smoke")["capture4"]]}),
        TrainingData(simulated={"capture4": ["0" * 64]}),
        TrainingData(private=["capture4"]),
    ],
)
def test_the_board_refuses_a_method_that_is_scored_on_what_it_learnt_from(
    tmp_path: Path, training: TrainingData, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(UsageError, match="was trained on capture4, on which it is scored"):
        check_entries([make_entry(learnt(training))])
    honest = make_entry(learnt(TrainingData(public=["HanCo"]), "other"))
    for entry in (honest, make_entry(learnt(training))):
        write_entry(tmp_path / "entries", entry)
    assert [entry.name for entry in sound_entries(tmp_path / "entries")] == [honest.name]
    assert main(["leaderboard", "check", "--entries", str(tmp_path / "entries")]) == 2
    assert "method.training" in capsys.readouterr().err


def test_a_declaration_belongs_to_the_files_of_the_method() -> None:
    """Those who run WildGHand as it ships cannot say that it learnt from nothing."""
    (shipped,) = (one for one in shipped_methods() if one.name == "wildghand")
    results = complete_results("wildghand")
    own = replace(results.method, digest=shipped.digest, training=shipped.training)
    honest = make_entry(replace(results, method=own))
    check_names([honest], frozenset({honest.digest}))
    wrong = make_entry(replace(results, method=replace(own, training=TrainingData())))
    with pytest.raises(
        UsageError, match=r"training data are none; the method\.toml of these files says sim"
    ):
        check_names([wrong], frozenset({wrong.digest}))


def test_results_without_a_declaration_are_refused(tmp_path: Path) -> None:
    file = write_results(tmp_path / "results.json", complete_results("mine"))
    value = json.loads(file.read_text("utf-8"))
    assert value["method"]["training"] == {"simulated": {}, "public": [], "private": []}
    del value["method"]["training"]
    file.write_text(json.dumps(value))
    with pytest.raises(BadResult, match=r"method.training: is missing"):
        read_results(file)


def test_evaluate_warns_and_records(
    make_capture: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = make_capture()
    file = write_manifest(tmp_path / "mine", "mine", SUBMISSION) / "method.toml"
    said = f'training = {{simulated = {{{capture.info.id} = ["{"a" * 64}"]}}}}'
    file.write_text(file.read_text().replace(CLEAN, said))
    results = evaluate(
        str(tmp_path / "mine"), [capture.root], tmp_path / "out", EvaluationSettings()
    )
    assert f"mine declares that it was trained on {capture.info.id}" in capsys.readouterr().err
    assert results.method.training == TrainingData(simulated={capture.info.id: ["a" * 64]})
