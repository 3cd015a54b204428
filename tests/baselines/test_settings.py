"""Settings of every baseline on the plain fit: each mistake is named with its remedy."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
from pathlib import Path
from typing import Any

import pytest

from hwp_bench.base.errors import BadMethod
from hwp_bench.methods import find_method, read_manifest
from hwp_bench.methods.settings import settings_from
from plain_fit.method import PlainMethod
from wildghand.plain.recipe import FitSettings, RecipeMethod

BASELINES = Path(__file__).resolve().parents[2] / "baselines"


def recipe_methods() -> dict[str, type[RecipeMethod]]:
    """The entry of each baseline that fits the plain model, by folder."""
    found = {}
    for folder in sorted(BASELINES.iterdir()):
        if not (folder / "method.toml").is_file():
            continue
        module, _, name = str(read_manifest(folder).entry.python).partition(":")
        entry = getattr(importlib.import_module(module), name)
        if inspect.isclass(entry) and issubclass(entry, RecipeMethod):
            found[folder.name] = entry
    return found


METHODS = recipe_methods()


def read_settings(values: dict[str, Any]) -> FitSettings:
    return settings_from(FitSettings, values, "here")


def test_the_plain_baseline_is_among_them() -> None:
    assert METHODS["plain"] is PlainMethod


def test_defaults_hold_where_nothing_is_said() -> None:
    assert read_settings({}) == FitSettings()
    assert read_settings({"steps": 7}) == dataclasses.replace(FitSettings(), steps=7)


def test_whole_numbers_do_for_real_ones() -> None:
    assert read_settings({"dssim_weight": 0}).dssim_weight == 0.0


@pytest.mark.parametrize("name", METHODS)
def test_unknown_setting_is_named_with_a_suggestion(name: str) -> None:
    match = rf"baselines/{name}.*gausians: is not known.*Did you mean 'gaussians'"
    with pytest.raises(BadMethod, match=match):
        METHODS[name]({"gausians": 100}, 0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gaussians", 0),
        ("gaussians", 1.5),
        ("gaussians", True),
        ("steps", "many"),
        ("batch", 1000),
        ("shading_degree", 4),
        ("dssim_weight", 1.5),
        ("outside_weight", -0.1),
        ("initial_opacity", 1.0),
        ("offset_rate", -1.0),
        ("color_rate", float("nan")),
        ("light_rate", float("inf")),
        ("final_rate", 0.0),
        ("device", "tpu"),
        ("device", ["cpu"]),
    ],
)
def test_values_out_of_range_are_named(name: str, value: Any) -> None:
    with pytest.raises(BadMethod, match=name):
        read_settings({name: value})


@pytest.mark.parametrize("name", METHODS)
def test_the_manifest_and_all_its_presets_can_be_read(name: str) -> None:
    manifest = read_manifest(find_method(name))
    assert manifest.kind == "python"
    assert {"default", "mini", "smoke"} <= set(manifest.presets)
    for settings in manifest.presets.values():
        settings_from(METHODS[name].settings_type, settings, name)


@pytest.mark.parametrize("name", METHODS)
def test_every_setting_has_a_line_of_documentation(name: str) -> None:
    kind = METHODS[name].settings_type
    for cls in kind.__mro__[:-1]:
        lines = inspect.getsource(cls).splitlines()
        for field in vars(cls).get("__annotations__", {}):
            row = next(i for i, line in enumerate(lines) if line.startswith(f"    {field}:"))
            assert lines[row - 1].strip().startswith("#:"), field


@pytest.mark.parametrize("name", METHODS)
def test_the_manifest_lists_every_setting(name: str) -> None:
    listed = read_manifest(find_method(name)).settings
    known = [item.name for item in dataclasses.fields(METHODS[name].settings_type)]
    assert sorted(listed) == sorted(known)
