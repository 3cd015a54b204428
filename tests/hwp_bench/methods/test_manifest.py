"""method.toml: what is accepted, and what every fault is called.

Settings that name files. Oracle: constructed methods and files.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from small_captures import CaptureMaker
from small_methods import SCRIPT, write_manifest

import hwp_bench
from hwp_bench.base.errors import BadMethod, HwpError, UsageError
from hwp_bench.cli.main import main
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import with_setting_files
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import (
    VALIDATION_USES,
    MethodManifest,
    check_settings,
    find_method,
    find_setting_files,
    read_manifest,
    shipped_methods,
    ships,
)
from hwp_bench.methods.settings import check_source, source_path

GOOD = """
schema = "hwp-method/1"
training = "none"
name = "mine"
title = "My method"
[entry]
python = "package.module:Make"
[presets.default]
steps = 100
[presets.smoke]
steps = 5
"""


def _write(folder: Path, text: str) -> Path:
    (folder / "method.toml").write_text(text)
    return folder


def test_a_manifest_is_read(tmp_path: Path) -> None:
    manifest = read_manifest(_write(tmp_path, GOOD))
    assert (manifest.name, manifest.title, manifest.kind) == ("mine", "My method", "python")
    assert manifest.entry.python == "package.module:Make"
    assert manifest.preset(None, "smoke") == "smoke"
    assert manifest.preset(None, "mini") == "default"
    assert manifest.preset("smoke") == "smoke"
    # The wild suites have the size of mini: its preset fits where they have none of their own.
    assert manifest.preset(None, "wild-dev") == "default"
    presets = {"mini": {}, "wild-dev": {}}
    assert replace(manifest, presets={"mini": {}}).preset(None, "wild-dev") == "mini"
    assert replace(manifest, presets=presets).preset(None, "wild-dev") == "wild-dev"
    with pytest.raises(BadMethod, match=r"no preset 'fast'. It has: default, smoke"):
        manifest.preset("fast")


def test_uses_of_validation_frames_are_declared_or_not(tmp_path: Path) -> None:
    assert read_manifest(_write(tmp_path, GOOD)).validation is None
    for uses in ([], ["shape"], list(VALIDATION_USES)):
        text = GOOD.replace("[entry]", f"validation = {uses}\n[entry]")
        assert read_manifest(_write(tmp_path, text)).validation == uses


def test_authors_terms_and_page_are_kept(tmp_path: Path) -> None:
    plain = read_manifest(_write(tmp_path, GOOD))
    assert (plain.authors, plain.licence, plain.url) == ("", "", "")
    text = (
        'authors = ["A. Hand", "B. Glove"]\nlicence = "MIT"\nurl = "https://mine.example"\n[entry]'
    )
    manifest = read_manifest(_write(tmp_path, GOOD.replace("[entry]", text)))
    assert manifest.authors == "A. Hand, B. Glove"
    assert (manifest.licence, manifest.url) == ("MIT", "https://mine.example")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("hwp-method/1", "hwp-method/9", "schema: is 'hwp-method/9'"),
        ('name = "mine"', 'name = "a/b"', "name: is 'a/b', expected a name of letters, digits"),
        ('name = "mine"', "name = 3", "name: is 3, expected a name of letters, digits"),
        (
            'title = "My method"',
            'title = "a\\nb"',
            "title: is 'a\\nb', expected one line of",
        ),
        (
            'title = "My method"',
            f'title = "{"x" * 2000}"',
            "xxx', expected one line of at most 1,000",
        ),
        (
            "[entry]",
            'validation = ["stopping"]\n[entry]',
            "validation[0]: is 'stopping', expected one of earlier-state, settings, shape",
        ),
        ("title", "titel", "titel: is not known. Did you mean 'title'?"),
        (
            "package.module:Make",
            "package/module",
            "entry.python: is 'package/module', expected module:callable",
        ),
        ("python =", "pyhton =", "entry.pyhton: is not known. Did you mean 'entry.python'?"),
        ("python =", 'command = ["x"]\npython =', "exactly one of python, command, predictions"),
        (
            "[presets.smoke]\nsteps = 5",
            "[presets]\nsmoke = 5",
            "presets.smoke: is 5, expected a table",
        ),
        ("[entry]", "[entry", "not valid TOML"),
        ('title = "My method"', 'title = "a\\u009bb"', "title: holds a control character"),
        ('title = "My method"', 'title = "a\\u202eb"', "title: holds a control character"),
        ("steps = 5", "steps = nan", "presets.smoke.steps: is nan, not a finite number"),
        ("steps = 5", "steps = [1, -inf]", "presets.smoke.steps: is -inf, not a finite number"),
        ("steps = 5", "steps = 1979-05-27", "presets.smoke.steps: is a date, not a"),
        ("steps = 5", f"steps = {'9' * 30}", "presets.smoke.steps: is too large a number"),
        ("steps = 5", f"steps = {'9' * 5000}", "absurdly large number"),
        ("steps = 5", f"steps = {'[' * 20}{']' * 20}", "presets.smoke.steps: is nested too deeply"),
        ("steps = 5", f"steps = {'[' * 3000}{']' * 3000}", "method.toml: is"),
    ],
)
def test_faults_are_named(tmp_path: Path, old: str, new: str, problem: str) -> None:
    assert old in GOOD
    with pytest.raises(BadMethod) as caught:
        read_manifest(_write(tmp_path, GOOD.replace(old, new)))
    assert problem in str(caught.value)
    assert "method.toml" in str(caught.value)


def test_a_huge_manifest_and_paths_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadMethod, match="larger than 65536 bytes"):
        read_manifest(_write(tmp_path, GOOD + "#" * 70_000))
    with pytest.raises(BadMethod, match="larger than 65536 bytes"):
        read_manifest(_write(tmp_path, GOOD.replace("My method", "x" * 10_000_000)))
    text = GOOD.replace('python = "package.module:Make"', 'predictions = "../elsewhere"')
    with pytest.raises(HwpError, match="leads out of the folder"):
        read_manifest(_write(tmp_path, text))


@pytest.mark.parametrize("name", ["plain", "network-scratch", "wildghand"])
def test_shipped_methods_are_found_from_any_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_manifest(find_method(name)).name == name
    if name != "wildghand":
        assert find_method(f"baselines/{name}/") == find_method(name)


def test_shipped_methods_are_found_in_a_wheel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside = tmp_path / "hwp_bench" / "_data" / "baselines" / "plain"
    inside.mkdir(parents=True)
    _write(inside, GOOD)
    monkeypatch.setattr("hwp_bench.base.packages.PACKAGES", tmp_path)
    monkeypatch.setattr("hwp_bench.methods.manifest.PACKAGES", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert find_method("plain") == find_method("baselines/plain") == inside
    assert [manifest.name for manifest in shipped_methods()] == ["mine"]


def install(site: Path, entries: dict[str, str]) -> None:
    """Install a distribution whose entry points name methods, as pip leaves it."""
    facts = site / "someones-1.0.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: someones\nVersion: 1.0\n")
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (facts / "entry_points.txt").write_text("\n".join(["[hwp_bench.methods]", *lines, ""]))


def test_methods_of_installed_packages_are_found_without_an_import(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    make_capture: CaptureMaker,
) -> None:
    site = tmp_path / "site"
    entries = {"someones": "someones_hands", "inner": "someones_hands.inner", "wrong": "nowhere"}
    install(site, {**entries, "plain": "someones_hands", "empty": "someones_hands.empty"})
    package = write_manifest(site / "someones_hands", "someones", SCRIPT)
    (package / "__init__.py").write_text("raise AssertionError('it was imported')\n")
    script = "import json, sys; json.load(open(sys.argv[1] + '/request.json')); sys.exit('no luck')"
    (package / "run.py").write_text(script)
    write_manifest(package / "inner", "inner", SCRIPT)
    monkeypatch.syspath_prepend(site)
    monkeypatch.chdir(tmp_path)
    assert find_method("someones") == package
    assert find_method("inner") == package / "inner"
    assert find_method("plain") != package  # what ships comes first
    assert not ships(package)
    with pytest.raises(BadMethod, match=r"it has no method\.toml"):
        find_method("wrong")
    assert main(["list", "methods", "--json"]) == 0
    out, err = capsys.readouterr()
    names = [row["method"] for row in json.loads(out)["methods"]]
    assert names == [*(one.name for one in shipped_methods()), "someones", "inner"]
    assert "left out: " in err
    assert "empty: is not a method directory" in err
    # It runs by its name: the script's own words come back.
    results = hwp_bench.evaluate("someones", make_capture(frames=20), tmp_path / "out")
    assert "no luck" in str(results.captures[0].failure)


def test_the_base_of_a_shipped_method_counts_as_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: a file of `wildghand` that is changed, in a package folder that is a copy.
    base, own = tmp_path / "wildghand", tmp_path / "own"
    base.mkdir()
    own.mkdir()
    (base / "fit.py").write_text("RATE = 1")
    monkeypatch.setattr(hwp_bench.methods.manifest, "PACKAGES", tmp_path)
    shipped, others = read_manifest(find_method("plain")), read_manifest(_write(own, GOOD))
    before = shipped.digest, others.digest
    (base / "fit.py").write_text("RATE = 2")
    assert shipped.digest != before[0]
    assert others.digest == before[1]


@pytest.mark.parametrize("name", ["../plain", "baselines/../wildghand", ".", ""])
def test_a_name_leads_to_no_other_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadMethod, match="not a method directory"):
        find_method(name)


SWITCHES = """
[switches.weighting]
title = "Weighting"
settings_off = {weighting = false}
[switches.binary-mask]
settings_on = {weighting = "mask"}
"""


def test_switches_are_read_in_the_order_of_the_file(tmp_path: Path) -> None:
    switches = read_manifest(_write(tmp_path, GOOD + SWITCHES)).switches
    assert list(switches) == ["weighting", "binary-mask"]
    component, alternative = switches.values()
    assert (component.title, component.variant_name) == ("Weighting", "no-weighting")
    assert (component.alternative, dict(component.settings)) == (False, {"weighting": False})
    assert (alternative.title, alternative.variant_name) == ("binary-mask", "binary-mask")
    assert (alternative.alternative, dict(alternative.settings)) == (True, {"weighting": "mask"})


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("switches.binary-mask", "switches.Binary", "is 'Binary', expected a name of lower-case"),
        ('title = "Weighting"', "title = 3", "weighting.title: is 3, expected one line"),
        (
            'title = "Weighting"',
            "titel = 3",
            "switches.weighting.titel: is not known. Did you mean",
        ),
        ("settings_off", "description = 'a'\nsettings_on = {a = 1}\nsettings_off", "exactly one"),
        ("settings_off = {weighting = false}", "", "exactly one of settings_off and settings_on"),
        ("{weighting = false}", "{}", "is {}, expected a table of at least one setting"),
        ("{weighting = false}", "{'a b' = 1}", "is 'a b', expected a name of a setting"),
        ("switches.binary-mask", "switches.no-weighting", "two switches make a variant"),
    ],
)
def test_faults_of_switches_are_named(tmp_path: Path, old: str, new: str, problem: str) -> None:
    assert old in SWITCHES
    with pytest.raises(BadMethod) as caught:
        read_manifest(_write(tmp_path, GOOD + SWITCHES.replace(old, new)))
    assert problem in str(caught.value)


def test_a_wrong_setting_is_refused_by_the_list_of_the_method(tmp_path: Path) -> None:
    (tmp_path / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\n'
        'name = "listed"\nsettings = ["steps", "light.degree", "former"]\n'
        '[entry]\npython = "a:b"\n[presets.default]\nlight.degree = 2\n'
    )
    manifest = read_manifest(tmp_path)
    manifest.check_setting_names({"steps": 3, "light.degree": 1, "former.name": 0})
    manifest.check_setting_names({"light": {"degree": 1}})
    with pytest.raises(BadMethod, match=r"--set: 'step' is not a setting.*Did you mean 'steps'"):
        manifest.check_setting_names({"step": 3}, "--set")
    with pytest.raises(BadMethod, match=r"'light.degre' is not .*Did you mean 'light.degree'"):
        manifest.check_setting_names({"light": {"degre": 1}})
    with pytest.raises(BadMethod, match=r"'degree' is not .*Did you mean 'light.degree'"):
        manifest.check_setting_names({"degree": 1})
    with pytest.raises(BadMethod, match=r"Known: steps, light, former"):
        manifest.check_setting_names({"xyz": 1})
    with pytest.raises(BadMethod, match=r"Known: light.degree\.$"):
        manifest.check_setting_names({"light.xyz": 1})


def test_presets_and_switches_must_have_listed_settings(tmp_path: Path) -> None:
    head = 'schema = "hwp-method/1"\ntraining = "none"\nname = "listed"\nsettings = ["steps"]\n'
    entry = '[entry]\npython = "a:b"\n'
    for table, field in (
        ("[presets.quick]\nstep = 3\n", "presets.quick"),
        ("[switches.few]\nsettings_on = { step = 3 }\n", "switches.few.settings_on"),
    ):
        (tmp_path / "method.toml").write_text(head + entry + table)
        with pytest.raises(BadMethod, match=f"{field}: 'step' is not a setting"):
            read_manifest(tmp_path)


def test_a_method_without_a_list_takes_any_setting(tmp_path: Path) -> None:
    write_manifest(tmp_path, "free", 'python = "a:b"')
    read_manifest(tmp_path).check_setting_names({"anything": {"at": "all"}})


def test_settings_may_be_a_class(tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text(
        "@dataclass\nclass Mine:\n    steps: int = 1\n    rate: float = 1"
    )
    _write(tmp_path, GOOD.replace("[entry]", 'settings = "code:Mine"\n[entry]'))
    assert read_manifest(tmp_path).settings == ["steps", "rate"]
    with pytest.raises(BadMethod, match=r"'rat' is not a setting of mine. Did you mean 'rate'"):
        read_manifest(tmp_path).check_setting_names({"rat": 2})
    _write(tmp_path, GOOD.replace("[entry]", 'settings = ["mode", "code:Mine"]\n[entry]'))
    assert read_manifest(tmp_path).settings == ["mode", "steps", "rate"]


MANIFEST = """schema = "hwp-method/1"
training = "none"
name = "listed"
settings = ["steps", "net.regions"]
files = { "net.regions" = ["sam"] }
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
