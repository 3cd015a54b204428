"""The documentation is true: links, commands, names and files in it exist, examples run."""

from __future__ import annotations

import argparse
import ast
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest

from hwp_bench.capture import Capture
from hwp_bench.cli.main import command_tree
from wildghand.cli.main import command_tree as wildghand_tree

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    *(
        ROOT / name
        for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "CODE_OF_CONDUCT.md")
    ),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "studies").glob("*.md")),
    *sorted((ROOT / "baselines").glob("*/README.md")),
]
#: What may open a path or a dotted name of this repository.
TOPS = ("baselines", "benchmarks", "docs", "hwp_bench", "splits", "tests", "tools", "wildghand")


def anchors(page: Path) -> set[str]:
    """The anchors of a page: of headings, as GitHub and the site make them, and written out."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}
    return slugs | set(re.findall(r'<a id="([\w-]+)"></a>', text))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_images_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    for target in targets:
        if not target.startswith(("http://", "https://")):
            file, _, anchor = target.partition("#")
            place = page.parent / file if file else page
            assert place.exists(), target
            assert not anchor or anchor in anchors(place), target


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


def example_commands(page: Path) -> list[list[str]]:
    """The words of every complete command in a page's blocks of code."""
    fences = r"^ *```(\w*)\n(.*?)^ *```$"
    found = re.findall(fences, page.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    blocks = [code for language, code in found if language in ("", "sh", "bash")]
    lines = [line.strip() for line in "\n".join(blocks).replace("\\\n", " ").splitlines()]
    # Lines with an ellipsis or a variable of a shell's loop are not complete.
    lines = [line for line in lines if " ... " not in f"{line} " and "$" not in line]
    programs = ("hwp-bench ", "wildghand ")
    return [shlex.split(line, comments=True) for line in lines if line.startswith(programs)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_evaluations_on_a_page_do_not_share_a_folder(page: Path) -> None:
    """Preset and settings are not in the name of a results folder, where other runs are refused."""
    seen: dict[tuple[str, ...], list[str]] = {}
    for words in example_commands(page):
        if words[:2] != ["hwp-bench", "evaluate"] or {"-o", "--out", "--overwrite"} & set(words):
            continue
        named = zip(words, ["", *words], strict=False)
        same = tuple(word for word, before in named if not {word, before} & {"--set", "--preset"})
        assert seen.setdefault(same, words) == words, " ".join(words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_are_accepted_by_their_commands(page: Path) -> None:
    for words in example_commands(page):
        command = {"hwp-bench": command_tree(), "wildghand": wildghand_tree()}[words[0]]
        rest = words[1:]
        while command.commands:
            command = command.commands[rest.pop(0)]
        parser = argparse.ArgumentParser(exit_on_error=False)
        add_arguments, _ = command.load()
        add_arguments(parser)
        try:
            parser.parse_args(rest)
        except (SystemExit, argparse.ArgumentError) as error:
            pytest.fail(f"{' '.join(words)}: {error}")


def test_the_first_pages_have_commands_to_check() -> None:
    assert len(example_commands(ROOT / "README.md")) > 4
    assert len(example_commands(ROOT / "docs" / "install.md")) > 12


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_modules_exist(page: Path) -> None:
    words = re.findall(r"`([\w./-]+)`", page.read_text(encoding="utf-8"))
    for word in words:
        if word.split("/")[0] in TOPS and "/" in word:
            # A package may be a module; pages about tests name them from `tests/`.
            places = (ROOT / word, ROOT / f"{word}.py", ROOT / "tests" / word)
            assert any(place.exists() for place in places), word
        elif word.split(".")[0] in (*TOPS, "plain_fit") and not word.endswith((".json", ".md")):
            assert is_defined(word), word


def is_defined(name: str) -> bool:
    """Whether a dotted name is a module, or is defined or given out by one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        for folder in (ROOT, *(ROOT / "baselines").iterdir()):
            base = folder.joinpath(*parts[:count])
            file = next(
                (f for f in (base.with_suffix(".py"), base / "__init__.py") if f.is_file()), base
            )
            if file.is_file():
                text = file.read_text(encoding="utf-8")
                if (stub := file.with_suffix(".pyi")).is_file():
                    text += stub.read_text(encoding="utf-8")
                return all(re.search(rf"\b{part}\b", text) for part in parts[count:])
            if base.is_dir() and count == len(parts):
                return True
    return False


def test_messages_of_the_page_of_troubles_are_those_of_the_programs() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text("utf-8")
    messages = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    assert len(messages) >= 20
    said = []
    for folder in ("hwp_bench", "wildghand"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    said.append(node.value)
    # A message with values consists of the parts between them.
    assert [text for text in messages if not any(text in part for part in said)] == []


@pytest.mark.parametrize(
    ("example", "entry", "settings"),
    [
        (0, "MyMethod", None),
        (1, "CappedMethod", "[presets.default]\ngaussians = 200\nsteps = 2\ncap = 0.2\n"),
    ],
    ids=["of the contract", "on the plain fit"],
)
def test_the_examples_of_the_method_contract_run(
    make_painted: Callable[[str], Capture],
    tmp_path: Path,
    example: int,
    entry: str,
    settings: str | None,
) -> None:
    from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
    from hwp_bench.evaluation.evaluate import evaluate

    page = (ROOT / "docs" / "methods.md").read_text()
    manifest = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)[0]
    code = re.findall(r"```python\n(.*?)```", page, re.DOTALL)[example]
    if settings is not None:
        head = 'schema = "hwp-method/1"\ntraining = "none"\nname = "capped"\ntitle = "Capped"\n'
        manifest = f'{head}[entry]\npython = "my_package.my_module:{entry}"\n{settings}'
    method = tmp_path / "method"
    (method / "my_package").mkdir(parents=True)
    (method / "method.toml").write_text(manifest)
    (method / "my_package" / "my_module.py").write_text(code)
    capture = make_painted("right")
    results = evaluate(str(method), [capture.root], tmp_path / "out", EvaluationSettings())
    assert results.captures[0].failure is None
    assert 5 < results.captures[0].frames[0].scores["psnr"] < 40
