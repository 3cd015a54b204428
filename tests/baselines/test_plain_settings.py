"""Settings from outside: each mistake is named with its remedy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from hwp_bench.base.errors import BadMethod
from hwp_bench.methods import find_method, read_manifest
from plain_fit.method import PlainMethod
from plain_fit.settings import PlainSettings, read_settings


def test_defaults_hold_where_nothing_is_said() -> None:
    assert read_settings({}) == PlainSettings()
    assert read_settings({"steps": 7}) == dataclasses.replace(PlainSettings(), steps=7)


def test_whole_numbers_do_for_real_ones() -> None:
    assert read_settings({"dssim_weight": 0}).dssim_weight == 0.0


def test_unknown_setting_is_named_with_a_suggestion() -> None:
    with pytest.raises(BadMethod, match=r"gausians: is not known.*Did you mean 'gaussians'"):
        PlainMethod({"gausians": 100}, 0)


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


def test_the_manifest_and_all_its_presets_can_be_read() -> None:
    manifest = read_manifest(find_method("plain"))
    assert manifest.kind == "python"
    assert {"default", "mini", "smoke"} <= set(manifest.presets)
    for settings in manifest.presets.values():
        read_settings(settings)


def test_every_setting_has_a_line_of_documentation() -> None:
    import plain_fit.settings as module

    lines = Path(module.__file__).read_text().splitlines()
    for field in dataclasses.fields(PlainSettings):
        row = next(i for i, line in enumerate(lines) if line.startswith(f"    {field.name}:"))
        assert lines[row - 1].strip().startswith("#:"), field.name


def test_the_manifest_lists_every_setting() -> None:
    listed = read_manifest(find_method("plain")).settings
    assert list(listed) == [field.name for field in dataclasses.fields(PlainSettings)]
