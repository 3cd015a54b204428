"""Which variants an ablation runs. Oracle: the grids of docs/statistics.md, by hand."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from hwp_bench.base.console import clock, remaining
from hwp_bench.base.errors import BadMethod, UsageError
from hwp_bench.base.records import unfold
from hwp_bench.evaluation.ablate.runs import make_design, run_ablation
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import Plan
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import MethodManifest, read_manifest

MANIFEST = """
schema = "hwp-method/1"
training = "none"
name = "mine"
[entry]
python = "a:B"
[switches.a]
title = "A"
settings_off = {a = false}
[switches.b]
title = "B"
settings_off = {b = 0}
[switches.c]
title = "C"
settings_off = {c = false, d = 1}
[switches.alt]
title = "Alt"
settings_on = {a = "alt"}
"""


@pytest.fixture
def manifest(tmp_path: Path) -> MethodManifest:
    (tmp_path / "method.toml").write_text(MANIFEST)
    return read_manifest(tmp_path)


def names(design) -> list[str]:
    return [variant.name for variant in design.variants]


def test_without_names_the_first_two_components_are_crossed(manifest) -> None:
    design = make_design(manifest)
    assert names(design) == ["no-a+no-b", "no-a", "no-b", "full"]
    assert dict(design.variants[0].settings) == {"a": False, "b": 0}
    assert [variant.title for variant in design.variants] == [
        "without A, B", "without A", "without B", "",
    ]  # fmt: skip
    a, _b, both = design.effects
    assert (a.title, a.kind) == ("A", "main")
    assert a.contrast == {"full": 0.5, "no-b": 0.5, "no-a": -0.5, "no-a+no-b": -0.5}
    assert (both.title, both.kind) == ("A x B", "interaction")
    assert both.contrast == {"full": 1, "no-a": -1, "no-b": -1, "no-a+no-b": 1}
    # Two components taken out one by one, and both: the same grid.
    assert make_design(manifest, ["a", "b"]) == design


def test_named_switches_are_thrown_alone_and_together(manifest) -> None:
    assert names(make_design(manifest, ["b"])) == ["no-b", "full"]
    design = make_design(manifest, ["a", "b", "c", "alt"])
    assert names(design) == ["no-a+no-b+no-c", "no-a", "no-b", "no-c", "full", "alt"]
    assert [(effect.title, effect.kind) for effect in design.effects] == [
        ("A", "out"), ("B", "out"), ("C", "out"), ("all of them", "out"),
        ("not Alt", "alternative"),
    ]  # fmt: skip
    assert design.effects[2].contrast == {"full": 1, "no-c": -1}
    assert names(make_design(manifest, ["alt"])) == ["full", "alt"]


def test_three_components_are_crossed_on_request(manifest) -> None:
    design = make_design(manifest, crossed=["a", "b", "c"])
    assert len(design.variants) == 8
    assert names(design)[0] == "no-a+no-b+no-c"
    for effect in design.effects:
        assert sum(effect.contrast.values()) == pytest.approx(0)
        gain = 2 if effect.kind == "interaction" else 1
        assert sum(f for f in effect.contrast.values() if f > 0) == pytest.approx(gain)
    assert [effect.title for effect in design.effects][3:6] == ["A x B", "A x C", "B x C"]


def test_what_cannot_be_ablated_is_refused(manifest, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"has no switch 'bb'.*Did you mean 'b'"):
        make_design(manifest, ["bb"])
    with pytest.raises(UsageError, match="either crossed or taken out"):
        make_design(manifest, ["a"], ["b"])
    with pytest.raises(UsageError, match="no alternatives, can be crossed"):
        make_design(manifest, crossed=["a", "alt"])
    (tmp_path / "method.toml").write_text(MANIFEST.split("[switches.a]")[0])
    with pytest.raises(UsageError, match="declares no component"):
        make_design(read_manifest(tmp_path))


def test_a_base_has_its_own_components(tmp_path: Path) -> None:
    table = """
[bases.bare]
settings = {mode = "bare"}
crossed = ["b"]
kept = ["c"]
"""
    (tmp_path / "method.toml").write_text(MANIFEST + table)
    manifest = read_manifest(tmp_path)
    design = make_design(manifest, base="bare")
    assert names(design) == ["no-b", "full"]
    assert [item.name for item in design.kept] == ["c"]
    assert [item.name for item in make_design(manifest).kept] == ["c"]
    assert [item.name for item in make_design(manifest, ["c", "alt"], base="bare").kept] == ["b"]
    with pytest.raises(UsageError, match=r"'a' is out of every variant.*In 'bare' are: b, c"):
        make_design(manifest, ["a"], base="bare")
    with pytest.raises(UsageError, match=r"has no base 'other'.*It declares: bare"):
        make_design(manifest, base="other")
    for old, new in (('["b"]', '["alt"]'), ('["c"]', '["b"]')):
        (tmp_path / "method.toml").write_text(MANIFEST + table.replace(old, new))
        with pytest.raises(BadMethod, match=r"bases\.bare.*(not a component|there twice)"):
            read_manifest(tmp_path)


TABLES = """
[presets.default]
light.degree = 2
light.lamp = true
light.rate = 0.1
[switches.sh]
settings_off = {light.degree = 0}
[switches.lamp]
settings_off = {light.lamp = false}
[bases.slow]
settings = {light.rate = 0.01}
crossed = ["sh", "lamp"]
"""


@pytest.mark.parametrize(
    ("base", "asked", "rate"),
    [
        (None, {}, 0.1),
        ("slow", {}, 0.01),
        (None, {"light": {"rate": 0.2}}, 0.2),
        ("slow", {"light.rate": 0.2}, 0.2),
    ],
)
def test_settings_of_one_table_do_not_replace_each_other(
    base: str | None,
    asked: dict[str, Any],
    rate: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Oracle: the table of each variant by hand.
    (tmp_path / "method.toml").write_text(MANIFEST.split("[switches.a]")[0] + TABLES)
    manifest, light = read_manifest(tmp_path), {}

    def keep(out: Path, plans: dict[str, Plan], *_: object, **__: object) -> None:
        for folder, plan in plans.items():
            light[folder] = unfold(plan.settings.run.settings)["light"]
        raise KeyboardInterrupt

    monkeypatch.setattr("hwp_bench.evaluation.ablate.runs.run_plans", keep)
    settings = EvaluationSettings(run=RunSettings(asked))
    with pytest.raises(KeyboardInterrupt):
        run_ablation(manifest, make_design(manifest, base=base), [], tmp_path, settings, [0])
    assert light == {
        f"variants/{name}/seed-0": {"degree": degree, "lamp": lamp, "rate": rate}
        for name, degree, lamp in (
            ("no-sh+no-lamp", 0, False),
            ("no-sh", 0, True),
            ("no-lamp", 2, False),
            ("full", 2, True),
        )
    }


def test_the_remaining_time_ignores_what_was_found_finished() -> None:
    assert remaining([], 3) is None
    assert remaining([0.01, 0.02, 10.0, 12.0], 4) == pytest.approx(44)
    assert (clock(59.6), clock(3723)) == ("1:00", "1:02:03")


def test_a_method_says_what_is_crossed_when_nothing_is_asked_for(manifest, tmp_path: Path) -> None:
    named = dataclasses.replace(manifest, crossed=("a", "b", "c"))
    assert make_design(named) == make_design(manifest, crossed=["a", "b", "c"])
    kinds = [effect.kind for effect in make_design(named).effects]
    # Three main effects, three interactions; each out of the full method, and all of them.
    assert kinds == ["main"] * 3 + ["interaction"] * 3 + ["out"] * 4
    root = tmp_path / "method"
    root.mkdir()
    text = (manifest.root / "method.toml").read_text()
    for wrong, message in (
        ('["a", "nothing"]', "'nothing' is not a component"),
        ('["a", "a"]', "twice"),
    ):
        (root / "method.toml").write_text(text.replace("[entry]", f"crossed = {wrong}\n[entry]"))
        with pytest.raises(BadMethod, match=message):
            read_manifest(root)
