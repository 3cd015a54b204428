"""Builds the documentation site: `python -m tools.docs_site OUT` writes `OUT/site` with zensical.

Next to `docs/` the site has pages that are files elsewhere (the README as home, the files at the
root that contributors read, a page of each baseline), and pages that are made here: commands,
settings, suites, scene files, and one page of API reference for each public package. The reference
shows the `#:` comments that document fields and constants. `mkdocs.yml` configures zensical.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints
from unittest import mock

from griffe import Attribute, Docstring, Extension

from hwp_bench.cli.main import command_tree
from hwp_bench.cli.main import main as hwp_bench
from hwp_bench.cli.program import Command
from wildghand.cli.main import command_tree as wildghand_tree
from wildghand.cli.main import main as wildghand
from wildghand.model.settings import WildGHandSettings

ROOT = Path(__file__).resolve().parents[1]

#: Page of the site by file at the root of the repository.
ROOT_PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "CODE_OF_CONDUCT.md": "code_of_conduct.md",
}
#: Packages with a page of reference; what their `__all__` lists is the public interface.
API = (
    "hwp_bench",
    "hwp_bench.capture",
    "hwp_bench.hands",
    "hwp_bench.methods",
    "hwp_bench.metrics",
    "hwp_bench.results",
    "wildghand",
    "wildghand.splat",
)
#: The records behind a scene file: the heading of a table, and its class in `hwp_bench.sim`.
SCENE_TABLES = {
    "top": "scene.scene.Scene",
    "camera": "scene.scene.SceneCamera",
    "track": "scene.scene.Track",
    "keys of hands": "scene.scene.HandKey",
    "estimator": "scene.scene.Estimator",
    "subject": "subject.subject.Subject",
    "subject.anatomy": "hand.anatomy.SubjectAnatomy",
    "subject.looks": "subject.subject.Looks",
    "tattoos": "subject.wear.Tattoo",
    "polish": "subject.wear.Polish",
    "rings": "subject.wear.Ring",
    "wrist": "subject.wear.WristWear",
    "gloves": "subject.wear.Glove",
    "light": "light.lights.Light",
    "light.lamps": "light.lights.Lamp",
    "light.room": "light.lights.Room",
    "sensor": "sensor.Sensor",
    "sensor.auto": "sensor.AutoControl",
    "behind.clutter": "props.behind.Clutter",
    "behind.face": "props.behind.Face",
    "behind.arm": "props.behind.OtherArm",
    "effects: hand_object_interaction": "effects.ObjectInteraction",
    "items of hand_object_interaction": "effects.ObjectItem",
    "effects: complex_poses": "effects.ComplexPoses",
    "effects: illumination": "effects.Illumination",
    "effects: motion_blur": "effects.MotionBlur",
}

_LINK = re.compile(r"\]\((?!https?://|#)([^)\s#]+)((?:#[^)\s]*)?)\)")


def write_pages(docs: Path) -> None:
    """Write every page of the site into a folder."""
    shutil.copytree(ROOT / "docs", docs)
    terms = glossary_terms((docs / "glossary.md").read_text(encoding="utf-8"))
    for path in (*docs.glob("*.md"), *docs.glob("studies/*.md")):
        text = _LINK.sub(lambda link: _moved(link, "../"), path.read_text(encoding="utf-8"))
        if path.parent == docs and path.name not in {"glossary.md", "ablation.md"}:
            text = link_terms(text, terms)
        path.write_text(text, encoding="utf-8")
    pages = {
        page: _from_root((ROOT / name).read_text("utf-8")) for name, page in ROOT_PAGES.items()
    }
    for name, page in _baseline_pages().items():
        pages[page] = (ROOT / name).read_text(encoding="utf-8").replace("](../../docs/", "](../")
    for package in API:
        names = getattr(importlib.import_module(package), "__all__", ())
        public = sorted(set(names) - {"__version__"})
        # A package whose names are lazy lists them in a stub, so they are named here.
        options = f"    options:\n      members: {public}\n" if public else ""
        pages[f"api/{package}.md"] = f"# `{package}`\n\n::: {package}\n{options}"
    pages["api/commands.md"] = _commands_page()
    pages["api/settings.md"] = _settings_page()
    pages["api/suites.md"] = _suites_page()
    pages["api/scenes.md"] = _scene_page()
    for page, text in pages.items():
        (docs / page).parent.mkdir(exist_ok=True)
        (docs / page).write_text(text, encoding="utf-8")


def glossary_terms(page: str) -> list[str]:
    """The words that a glossary explains, the longest first."""
    terms = re.findall(r"^\| (\w[\w -]*) \| (?!meaning)", page, re.MULTILINE)
    return sorted(terms, key=len, reverse=True)


def link_terms(page: str, terms: Sequence[str]) -> str:
    """Link the first use of each term in the paragraphs of a page to the glossary."""
    lines, code, left = [], False, list(terms)
    for line in page.split("\n"):
        code ^= line.lstrip().startswith("```")
        if not (code or line.startswith(("#", "|", "<", "![", "    "))):
            for term in list(left):
                # Spans of code and links are left alone.
                pattern = rf"(`[^`]*`|!?\[[^\]]*\]\([^)]*\))|(?<![\w-])({term}s?)(?![\w-])"
                uses = [use for use in re.finditer(pattern, line, re.IGNORECASE) if use[2]]
                if uses:
                    start, end = uses[0].span()
                    line = f"{line[:start]}[{uses[0][2]}](glossary.md){line[end:]}"
                    left.remove(term)
        lines.append(line)
    return "\n".join(lines)


def build(folder: Path) -> Path:
    """Write the pages into a folder and build the site from them; a warning ends it."""
    docs = folder / "docs"
    if docs.exists() and not (docs / "api" / "commands.md").is_file():
        raise SystemExit(f"{docs}: holds something else than pages of this program")
    shutil.rmtree(docs, ignore_errors=True)
    write_pages(docs)
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    (folder / "mkdocs.yml").write_text(config.replace("$ROOT", str(ROOT)), encoding="utf-8")
    program = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    subprocess.run(program, cwd=folder, check=True)
    return folder / "site"


def _commands_page() -> str:
    """The reference of the command lines: the help of every command."""
    parts = ["# Commands", "", "The help of every command, as `--help` prints it."]
    for program, tree, run in (
        ("hwp-bench", command_tree(), hwp_bench),
        ("wildghand", wildghand_tree(), wildghand),
    ):
        parts += ["", f"## {program}", "", "```text", _printed(run, ["--help"]), "```"]
        for words in _leaves(tree):
            help_text = _printed(run, [*words, "--help"])
            parts += ["", f"### {program} {' '.join(words)}", "", "```text", help_text, "```"]
    return "\n".join(parts) + "\n"


def _leaves(tree: Command) -> Iterator[list[str]]:
    for name, command in tree.commands.items():
        if command.commands:
            yield from ([name, *words] for words in _leaves(command))
        else:
            yield [name]


def _printed(run: Callable[[list[str]], int], words: list[str]) -> str:
    """Return what a command prints on a console of 90 columns."""
    out = StringIO()
    with mock.patch.dict(os.environ, COLUMNS="90"), redirect_stdout(out), suppress(SystemExit):
        run(words)
    return out.getvalue().strip("\n")


def _settings_page() -> str:
    """The reference of WildGHand's settings: every field with its default, range and meaning."""
    parts = [
        "# Settings of WildGHand",
        "",
        "Give a setting as `--set NAME=VALUE` or in a preset of `method.toml`. A setting of a table"
        " is `TABLE.NAME`, such as `dpd.enabled`. [Modes](../dpd_pao.md#three-readings) are sets of"
        " them. Defaults are those of the mode `default`.",
        "",
        *_table(WildGHandSettings),
    ]
    for field in dataclasses.fields(WildGHandSettings):
        kind = field.default_factory
        if dataclasses.is_dataclass(kind):
            parts += ["", f"## {field.name}", "", *_table(kind)]
    return "\n".join(parts) + "\n"


def _suites_page() -> str:
    """The reference of suites, captures, methods and metrics, as `hwp-bench list` prints them."""
    parts = ["# Suites, captures, methods, metrics", "", "As `hwp-bench list` prints them."]
    for what in ("suites", "captures", "perturbations", "methods", "metrics"):
        parts += ["", f"## {what.capitalize()}", "", "```text", _printed(hwp_bench, ["list", what])]
        parts += ["```"]
    return "\n".join(parts) + "\n"


def _scene_page() -> str:
    """The reference of scene files: every field with its default, range and meaning."""
    parts = ["# Scene files", "", "The fields of [a scene](../simulation.md#a-scene), by table."]
    for title, name in SCENE_TABLES.items():
        module, _, record = name.rpartition(".")
        kind = getattr(importlib.import_module(f"hwp_bench.sim.{module}"), record)
        parts += ["", f"## {title}", "", *_table(kind)]
    return "\n".join(parts) + "\n"


def _table(record: Any) -> list[str]:
    """The fields of a dataclass as a table."""
    head = ["| field | default | range | meaning |", "| - | - | - | - |"]
    source = re.findall(r"((?:^    #: .*\n)+)    (\w+):", inspect.getsource(record), re.MULTILINE)
    meanings = {name: " ".join(comment.replace("#:", "").split()) for comment, name in source}
    hints = get_type_hints(record, include_extras=True)
    rows = []
    for field in dataclasses.fields(record):
        default = field.default
        if default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            shown = "required"
        else:
            # Tables and lists have a heading of their own.
            plain = isinstance(default, str | int | float | tuple) and default != ()
            shown = f"`{default}`" if plain else ""
        meaning = meanings.get(field.name, "").replace("|", "\\|")
        rows.append(f"| `{field.name}` | {shown} | {_range(field, hints)} | {meaning} |")
    return head + rows


def _range(field: dataclasses.Field[Any], hints: dict[str, Any]) -> str:
    if field.metadata.get("range"):
        return "{:g} to {:g}".format(*field.metadata["range"])
    if field.metadata.get("choices"):
        return ", ".join(f"`{word}`" for word in field.metadata["choices"])
    hint = hints[field.name]
    for part in (hint, *get_args(hint)):
        if get_origin(part) is Literal:
            return ", ".join(f"`{word}`" for word in get_args(part))
        bounds = [meta for meta in getattr(part, "__metadata__", ()) if hasattr(meta, "ge")]
        if bounds and bounds[0].le is not None:
            low, high = bounds[0].ge, bounds[0].le
            return f"{low:g} to {high:g}" if high < 1e9 else f"from {low:g}"
    return ""


def _baseline_pages() -> dict[str, str]:
    """Page of the site by the README of each baseline, from the root of the repository."""
    pages = sorted((ROOT / "baselines").glob("*/README.md"))
    return {page.relative_to(ROOT).as_posix(): f"baselines/{page.parent.name}.md" for page in pages}


def _from_root(text: str) -> str:
    text = _LINK.sub(lambda link: _moved(link, ""), text)
    return re.sub(r"\]\(docs/", "](", text)


def _moved(link: re.Match[str], prefix: str) -> str:
    pages = ROOT_PAGES | _baseline_pages()
    page = pages.get(link[1].removeprefix(prefix)) if link[1].startswith(prefix) else None
    return f"]({page}{link[2]})" if page else link[0]


class FieldComments(Extension):
    """Takes the `#:` comments above a field or constant as its docstring."""

    def on_attribute(self, *, attr: Attribute, **_: Any) -> None:
        """Give one attribute its docstring."""
        if attr.docstring or attr.lineno is None or not isinstance(attr.filepath, Path):
            return
        lines = attr.lines_collection[attr.filepath]
        first = attr.lineno - 1
        while first > 0 and lines[first - 1].lstrip().startswith("#:"):
            first -= 1
        comments = [
            line.strip().removeprefix("#:").strip() for line in lines[first : attr.lineno - 1]
        ]
        if comments:
            attr.docstring = Docstring("\n".join(comments), lineno=first + 1, parent=attr)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder for pages and site")
    print(build(parser.parse_args().out))
