"""The documentation is true: links lead somewhere, commands exist, examples run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from small_captures import CaptureMaker

from hwp_bench.cli.main import command_tree
from wildghand.cli.main import command_tree as wildghand_tree

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    for target in targets:
        if not target.startswith(("http://", "https://", "#")):
            assert (page.parent / target.split("#")[0]).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_exist(page: Path) -> None:
    trees = {"hwp-bench": command_tree(), "wildghand": wildghand_tree()}
    text = page.read_text(encoding="utf-8")
    for program, words in re.findall(r"(?:^|[`/ ])(hwp-bench|wildghand) ([a-z][a-z -]*)", text):
        command = trees[program]
        for word in words.split():
            if not command.commands:
                break
            assert word in command.commands, f"{program} {words}"
            command = command.commands[word]


def test_the_example_of_the_method_contract_runs(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    from hwp_bench.evaluate.evaluation import EvaluationSettings, evaluate

    blocks = re.findall(
        r"```(toml|python)\n(.*?)```", (ROOT / "docs" / "methods.md").read_text(), re.DOTALL
    )
    code = dict(blocks)
    method = tmp_path / "method"
    (method / "my_package").mkdir(parents=True)
    (method / "method.toml").write_text(code["toml"])
    (method / "my_package" / "my_module.py").write_text(code["python"])
    capture = make_capture(frames=20, size=48)
    results = evaluate(str(method), [capture.root], tmp_path / "out", EvaluationSettings())
    assert results.captures[0].failure is None
    assert 5 < results.captures[0].frames[0].scores["psnr"] < 40
