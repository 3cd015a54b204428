"""Builds the documentation site: `mkdocs build --strict` reads `mkdocs.yml`, which loads this.

It adds pages that are not files below `docs/` (the README as home, the files at the root that
contributors read, the page of each baseline, one page of API reference for each public package, and
one of the tables of scene files), and gives the reference the `#:` comments that document fields
and constants.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from griffe import Attribute, Docstring, Extension
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]

#: Page of the site by file at the root of the repository.
ROOT_PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
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


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages that are not below `docs/`."""
    for name, page in ROOT_PAGES.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_from_root(text)))
    for name, page in _baseline_pages().items():
        text = (ROOT / name).read_text(encoding="utf-8").replace("](../../docs/", "](../")
        files.append(File.generated(config, page, content=text))
    for package in API:
        names = getattr(importlib.import_module(package), "__all__", ())
        public = sorted(set(names) - {"__version__"})
        # A package whose names are lazy lists them in a stub, so they are named here.
        options = f"    options:\n      members: {public}\n" if public else ""
        text = f"# `{package}`\n\n::: {package}\n{options}"
        files.append(File.generated(config, f"api/{package}.md", content=text))
    files.append(File.generated(config, "api/scenes.md", content=_scene_page()))
    return files


def _scene_page() -> str:
    """The reference of scene files: every field with its default, range and meaning."""
    parts = ["# Scene files", "", "The fields of [a scene](../simulation.md#a-scene), by table."]
    for title, name in SCENE_TABLES.items():
        module, _, record = name.rpartition(".")
        kind = getattr(importlib.import_module(f"hwp_bench.sim.{module}"), record)
        parts += [
            "",
            f"## {title}",
            "",
            "| field | default | range | meaning |",
            "| - | - | - | - |",
        ]
        parts += _field_rows(kind)
    return "\n".join(parts) + "\n"


def _field_rows(record: type) -> list[str]:
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
    return rows


def _range(field: dataclasses.Field[Any], hints: dict[str, Any]) -> str:
    if field.metadata.get("range"):
        return "{:g} to {:g}".format(*field.metadata["range"])
    hint = hints[field.name]
    for part in (hint, *get_args(hint)):
        if get_origin(part) is Literal:
            return ", ".join(f"`{word}`" for word in get_args(part))
        bounds = [meta for meta in getattr(part, "__metadata__", ()) if hasattr(meta, "ge")]
        if bounds and bounds[0].le is not None:
            low, high = bounds[0].ge, bounds[0].le
            return f"{low:g} to {high:g}" if high < 1e9 else f"from {low:g}"
    return ""


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links from `docs/` to the pages that were added."""
    if page.file.generated_by:
        return markdown
    return _LINK.sub(lambda link: _moved(link, "../"), markdown)


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
