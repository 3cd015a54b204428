"""The places that a sandbox shows. Oracle: the file system that the test builds."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.base.kernels import KEPT
from hwp_bench.base.packages import data_folder
from hwp_bench.run.sandbox.confinement import (
    Confinement,
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
