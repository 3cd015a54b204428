"""The places that a sandbox shows. Oracle: the file system that the test builds.

What methods do not see in folders that are shown. Oracle: the file system that the test builds,
and what a program inside the walls finds by itself.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
from walled_script import run_walled

from hwp_bench.base.errors import UsageError
from hwp_bench.base.kernels import KEPT
from hwp_bench.base.packages import PACKAGES, data_folder
from hwp_bench.methods import contents
from hwp_bench.methods.contents import unseen_folders
from hwp_bench.run.sandbox.confinement import (
    VISIBLE_PACKAGES,
    Confinement,
    hidden_packages,
    package_paths,
    sandbox_environment,
    visible_places,
)


def test_outer_places_come_first_and_the_deeper_rule_wins(tmp_path: Path) -> None:
    library = tmp_path / "library"
    work = library / "results" / "run"
    work.mkdir(parents=True)
    places = visible_places(read=[library], write=[work], hidden=[library / "results"])
    paths = [path for _, path, _ in places]
    for path in paths:
        assert not any(Path(path).is_relative_to(later) for later in paths[paths.index(path) + 1 :])
    kinds = {path: kind for kind, path, _ in places}
    assert kinds[str(library)] == "read"
    assert kinds[str(library / "results")] == "hidden"
    assert kinds[str(work)] == "write"
    assert "/" not in kinds
    assert "/etc/shadow" not in kinds
    assert "/etc" not in kinds


def test_links_on_the_way_are_kept_as_links(tmp_path: Path) -> None:
    real = tmp_path / "real" / "weights"
    real.mkdir(parents=True)
    (tmp_path / "link").symlink_to("real")
    places = visible_places(read=[tmp_path / "link" / "weights", tmp_path / "absent"], write=[])
    assert ("link", str(tmp_path / "link"), "real") in places
    assert ("read", str(real), "") in places
    assert not any("absent" in path for _, path, _ in places)


def test_a_circle_of_links_ends(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    assert visible_places(read=[tmp_path / "a"], write=[])


def test_the_interpreters_that_are_shown_are_a_fixed_list(tmp_path: Path) -> None:
    """Another one is shown where a person names it, and not where a method does."""
    for name in ("env", "base"):
        (tmp_path / name / "bin").mkdir(parents=True)
    (tmp_path / "base" / "bin" / "python").touch()
    (tmp_path / "env" / "bin" / "python").symlink_to(tmp_path / "base" / "bin" / "python")
    (tmp_path / "env" / "pyvenv.cfg").touch()
    places = visible_places(read=[tmp_path / "env"], write=[])
    paths = [path for _, path, _ in places]
    assert str(tmp_path / "env") in paths
    assert not any(str(tmp_path / "base") in word for place in places for word in place)
    assert sys.prefix in paths
    both = visible_places(read=[tmp_path / "env", tmp_path / "base"], write=[])
    assert str(tmp_path / "base") in [path for _, path, _ in both]


def test_of_a_project_on_the_path_only_what_is_imported_is_shown(tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__init__.py").touch()
    (tmp_path / "secrets").mkdir()
    for name in ("module.py", ".env", "notes.txt"):
        (tmp_path / name).touch()
    assert package_paths(str(tmp_path)) == [str(tmp_path)]  # a folder of packages, such as src/
    (tmp_path / "pyproject.toml").touch()
    shown = sorted(Path(path).name for path in package_paths(str(tmp_path)))
    assert shown == ["module.py", "package"]


@pytest.mark.parametrize("wrong", [{"mode": "maybe"}, {"memory_limit": 0}])
def test_wrong_settings_are_named(wrong: dict) -> None:
    with pytest.raises(UsageError):
        Confinement(**wrong)


@pytest.mark.parametrize("place", ["/", "/proc", "/proc/1/cwd", "/dev/../sys", "/dev/shm"])
def test_what_would_open_the_machine_is_not_exposed(place: str) -> None:
    with pytest.raises(UsageError, match="would open the whole machine") as caught:
        Confinement(exposed=(Path(place),))
    assert caught.value.field == "--expose"


def test_only_methods_that_ship_compile_for_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy of a shipped method in another place is somebody else's."""
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "toolkit"))
    copy = tmp_path / "plain"
    copy.mkdir()
    (tmp_path / "request").mkdir()
    for method, ships in ((data_folder("baselines") / "plain", True), (copy, False)):
        output = tmp_path / f"output-{ships}"
        output.mkdir()
        environment, places = sandbox_environment(
            method, tmp_path / "request", output, Confinement()
        )
        kernels = str(tmp_path / "toolkit" / "kernels")
        assert environment["HWP_CACHE"] == str(output / "cache")
        assert environment["HWP_KERNELS"] == kernels
        assert (environment.get(KEPT) == kernels) == ships
        kinds = {path: kind for kind, path, _ in places}
        assert kinds[kernels] == ("write" if ships else "read")
        assert kinds[str(tmp_path / "toolkit")] == "hidden"


def test_every_part_of_the_toolkit_is_shown_or_hidden() -> None:
    parts = {path.parent.name for path in (PACKAGES / "hwp_bench").glob("*/__init__.py")}
    # `_data` is there in a wheel only. A new part must be put on one side or the other, here too.
    assert VISIBLE_PACKAGES - {"_data"} < parts
    hidden = {"commitments", "evaluation", "leaderboard", "sim", "suites"}
    assert parts - VISIBLE_PACKAGES == hidden


def test_a_method_finds_no_simulator_and_no_scene(tmp_path: Path) -> None:
    script = """
def imports(name):
    try:
        __import__(name)
    except ImportError:
        return False
    return True
found = []
for top, folders, files in os.walk("/"):
    folders[:] = [name for name in folders if top != "/" or name not in ("proc", "sys")]
    inside = f"{os.sep}hwp_bench{os.sep}" in top + os.sep
    found += [os.path.join(top, name) for name in files
              if inside and name in ("production.py", "capture0.toml")]
names = [name for name in NAMES if imports(name)]
print(json.dumps({"found": found, "imports": names}))
"""
    hidden = [
        "hwp_bench.sim.produce.capture",
        "hwp_bench.sim.produce.capture",
        "hwp_bench.sim.scene.scene",
        "hwp_bench.evaluation.evaluate",
        "hwp_bench.leaderboard.rules",
    ]
    names = [*hidden, "hwp_bench.hands.poses"]
    # What is not there at all would be hidden too.
    assert all(importlib.util.find_spec(name) for name in names)
    found = run_walled(tmp_path, f"NAMES = {names!r}\n{script}")
    assert found == {"found": [], "imports": ["hwp_bench.hands.poses"]}


def test_methods_that_ship_find_all_that_they_import(tmp_path: Path) -> None:
    """Every module of every baseline and of the reference method, but those that paint data."""
    baselines = data_folder("baselines")
    script = f"""
import importlib, pathlib, tomllib
wrong, count = [], 0
for manifest in [*pathlib.Path({str(baselines)!r}).glob("*/method.toml"),
                 pathlib.Path({str(PACKAGES / "wildghand")!r}) / "method.toml"]:
    entry = tomllib.loads(manifest.read_text())["entry"].get("python")
    if entry is None:
        continue
    sys.path.insert(0, str(manifest.parent))
    module = importlib.import_module(entry.partition(":")[0])
    names = [entry.partition(":")[0]]
    package = manifest.parent / names[0].split(".")[0]
    if package.is_dir():
        names += [f"{{package.name}}.{{path.stem}}" for path in package.glob("[a-z]*.py")
                  if path.stem != "build"]
    for name in names:
        count += 1
        try:
            importlib.import_module(name)
        except ImportError as error:
            wrong.append(f"{{name}}: {{error}}")
import wildghand.avatar.studio, wildghand.fitting
print(json.dumps({{"wrong": wrong, "enough": count > 10}}))
"""
    assert run_walled(tmp_path, script, exposed=(baselines,)) == {"wrong": [], "enough": True}


def test_every_copy_of_the_toolkit_is_found(tmp_path: Path) -> None:
    for place in ("library", "env/lib/python3.11/site-packages"):
        for part in ("base", "sim", "unheard_of"):
            (tmp_path / place / "hwp_bench" / part).mkdir(parents=True)
        (tmp_path / place / "hwp_bench" / "__init__.py").touch()
    (tmp_path / "other" / "hwp_bench" / "sim").mkdir(parents=True)  # no package of that name
    found = hidden_packages(str(tmp_path / name) for name in ("library", "env", "other"))
    names = sorted(Path(path).relative_to(tmp_path).as_posix() for path in found)
    inside = "env/lib/python3.11/site-packages/hwp_bench"
    assert names == [
        f"{inside}/sim",
        f"{inside}/unheard_of",
        "library/hwp_bench/sim",
        "library/hwp_bench/unheard_of",
    ]
    kinds = {path: kind for kind, path, _ in visible_places(read=[tmp_path / "library"], write=[])}
    assert kinds[str(tmp_path / "library" / "hwp_bench" / "sim")] == "hidden"


def test_of_a_checkout_only_packages_are_shown(tmp_path: Path) -> None:
    for name in ("hwp_bench", "wildghand"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    for name in ("runs", "tests"):
        (tmp_path / name).mkdir()
    assert package_paths(str(tmp_path)) == [str(tmp_path)]
    (tmp_path / "pyproject.toml").touch()
    shown = sorted(Path(path).name for path in package_paths(str(tmp_path)))
    assert shown == ["hwp_bench", "wildghand"]
    # A folder that is shown for another reason does not bring the checkout along.
    if (PACKAGES / "pyproject.toml").is_file():
        places = visible_places(read=[PACKAGES.parent], write=[])
        kinds = {path: kind for kind, path, _ in places}
        assert kinds[str(PACKAGES)] == "hidden"
        assert kinds[str(PACKAGES / "hwp_bench")] == "read"


def _litter(method: Path) -> list[Path]:
    """Leave what runs and captures leave; returns the folders that must not be seen."""
    foreign = [
        method / "runs" / "plain-smoke",
        method / "runs" / "ended",
        method / "deep" / "capture4",
        method / "runs" / ".plain-mini.0123456789ab",
    ]
    for folder in foreign:
        (folder / "pictures").mkdir(parents=True)
        (folder / "pictures" / "truth.png").write_bytes(b"a test frame")
    (foreign[0] / "results.json").write_text('{"schema": "hwp-results/5"}')
    (foreign[1] / ".lock").touch()
    (foreign[2] / "capture.json").write_text('{\n "schema": "hwp-capture/1",\n "id": "x"}')
    return foreign


def test_runs_and_captures_below_a_method_are_not_the_methods(tmp_path: Path) -> None:
    foreign = _litter(tmp_path)
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "results.json").write_text('{"accuracy": 0.5}')
    assert unseen_folders(tmp_path) == sorted(foreign)


def test_too_many_folders_are_one_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contents, "MAX_FOLDERS", 3)
    _litter(tmp_path)
    with pytest.raises(UsageError, match="holds more than 3 folders"):
        unseen_folders(tmp_path)


def test_a_method_does_not_see_earlier_runs_below_it(tmp_path: Path) -> None:
    method = tmp_path / "method"
    (method / "weights").mkdir(parents=True)
    (method / "weights" / "truth.png").write_bytes(b"its own")
    foreign = _litter(method)
    script = """
here = os.path.dirname(__file__)
print(json.dumps(sorted(os.path.relpath(os.path.join(top, name), here)
    for top, _, files in os.walk(here) for name in files if name == "truth.png")))
"""
    seen = run_walled(tmp_path, script, exposed=(foreign[2],))
    assert seen == ["deep/capture4/pictures/truth.png", "weights/truth.png"]


@pytest.mark.skipif(sys.platform != "linux", reason="there are no walls elsewhere")
def test_exposing_what_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not exist"):
        run_walled(tmp_path, "print(0)", exposed=(tmp_path / "absent",))


def test_standard_streams_have_their_usual_names(tmp_path: Path) -> None:
    """Shell scripts and programs write to /dev/stderr, and a name that is not there is an error."""
    script = """
streams = [os.readlink(f"/dev/{name}") for name in ("stdin", "stdout", "stderr")]
with open("/dev/stderr", "a") as stream:
    print("said", file=stream)
json.dump(streams, sys.stdout)
"""
    assert run_walled(tmp_path, script) == [f"/proc/self/fd/{number}" for number in range(3)]
