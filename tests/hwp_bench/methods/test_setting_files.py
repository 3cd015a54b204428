"""Settings that name files. Oracle: constructed methods and files."""

from __future__ import annotations

from pathlib import Path

import pytest

from hwp_bench.base.errors import BadMethod, UsageError
from hwp_bench.evaluation.evaluate import EvaluationSettings, with_setting_files
from hwp_bench.methods import find_method, read_manifest
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import MethodManifest, check_settings, find_setting_files
from hwp_bench.methods.settings import check_source, source_path

MANIFEST = """schema = "hwp-method/1"
name = "listed"
settings = ["steps", "net.regions"]
files = { "net.regions" = ["sam"] }
check_files = "no_such_module:nothing"
[entry]
python = "a:b"
[presets.default]
net.regions = "sam:/etc/passwd"
"""


@pytest.fixture
def manifest(tmp_path: Path) -> MethodManifest:
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "method.toml").write_text(MANIFEST)
    return read_manifest(tmp_path / "method")


def test_a_file_that_a_setting_names_is_shown_to_the_method(
    manifest: MethodManifest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights.pth").write_bytes(b"1")
    absolute = f"sam:{tmp_path / 'weights.pth'}"
    for values, made in (
        ({"net.regions": "sam:weights.pth"}, {"net.regions": absolute}),
        ({"net": {"regions": "sam:./weights.pth"}}, {"net": {"regions": absolute}}),
    ):
        settings = EvaluationSettings(run=RunSettings(values))
        chosen = with_setting_files(manifest, settings)
        assert chosen.run.settings == made
        assert chosen.confinement.exposed == (tmp_path / "weights.pth",)
        # An ablation does it, and each of its evaluations again.
        assert with_setting_files(manifest, chosen) == chosen
    words = {"net.regions": "superpixels", "steps": "sam:weights.pth", "other": 3}
    assert find_setting_files(manifest, words) == (words, ())


def test_a_preset_exposes_nothing(manifest: MethodManifest) -> None:
    assert manifest.presets["default"]["net"]["regions"] == "sam:/etc/passwd"
    chosen = with_setting_files(manifest, EvaluationSettings())
    assert chosen.confinement.exposed == ()


def test_a_file_that_is_not_there_is_refused(manifest: MethodManifest, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none.*net\.regions: does not exist.*sam:PATH"):
        check_settings(manifest, {"net.regions": f"sam:{tmp_path / 'none'}"})
    with pytest.raises(UsageError, match="names no file"):
        check_settings(manifest, {"net.regions": "sam:"})
    with pytest.raises(BadMethod, match=r"--set: 'net\.region' is not"):
        check_settings(manifest, {"net.region": "sam:x"}, "--set")


def test_nothing_of_a_method_that_does_not_ship_is_imported(
    manifest: MethodManifest, tmp_path: Path
) -> None:
    (tmp_path / "weights").mkdir()
    check_settings(manifest, {"net.regions": f"sam:{tmp_path / 'weights'}"})


def test_a_rule_for_a_setting_that_is_not_there_is_refused(tmp_path: Path) -> None:
    (tmp_path / "method.toml").write_text(MANIFEST.replace('"steps", "net.regions"', '"steps"'))
    with pytest.raises(BadMethod, match=r"files: 'net\.regions' is not a setting"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("method", ["wildghand", "network-scratch"])
def test_the_shipped_rules_are_those_of_the_settings(method: str) -> None:
    files = read_manifest(find_method(method)).files
    kinds = {"pao.regions": ["sam"], "pao.hand": ["sam"], "perceptual": ["vgg19"]}
    assert dict(files) == kinds


def test_words_and_kinds() -> None:
    for value in ("superpixels", "sam:/a:b"):
        check_source(value, "regions", ("superpixels",), ["sam"])
    for value in ("sam:", "sam", "vgg:/a", "Superpixels", ""):
        with pytest.raises(UsageError, match=r"regions: is .*Use superpixels or sam:PATH"):
            check_source(value, "regions", ("superpixels",), ["sam"])
    assert source_path("sam:/a:b") == "/a:b"
    assert source_path("superpixels") is None
