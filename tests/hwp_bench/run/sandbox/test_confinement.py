"""The places that a sandbox shows. Oracle: the file system that the test builds."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.run.sandbox import confinement
from hwp_bench.run.sandbox.confinement import Confinement, visible_places


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


def test_a_command_shows_its_python_environment_and_nothing_else_that_it_names(
    tmp_path: Path,
) -> None:
    for name in ("env", "home"):
        (tmp_path / name / "bin").mkdir(parents=True)
        (tmp_path / name / "bin" / "tool").touch()
    (tmp_path / "env" / "pyvenv.cfg").touch()
    for name, shown in (("env", True), ("home", False)):
        program = str(tmp_path / name / "bin" / "tool")
        paths = [path for _, path, _ in visible_places(read=[], write=[], program=program)]
        assert (str(tmp_path / name) in paths) == shown
    assert sys.prefix in [path for _, path, _ in visible_places(read=[], write=[])]


@pytest.mark.parametrize("wrong", [{"mode": "maybe"}, {"memory_limit": 0}])
def test_wrong_settings_are_named(wrong: dict) -> None:
    with pytest.raises(UsageError):
        Confinement(**wrong)


def test_a_method_that_ships_has_one_cache_in_every_installation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its machine code is found after an update; methods elsewhere have one for each place."""
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "cache"))
    found = []
    for name in ("one", "two"):
        root = tmp_path / name
        for method in ("baselines/plain", "baselines/other", "wildghand", "mine"):
            (root / method).mkdir(parents=True)
        monkeypatch.setattr(confinement, "PACKAGES", root)
        monkeypatch.setattr(confinement, "data_folder", root.joinpath)
        places = ("baselines/plain", "baselines/other", "wildghand", "mine")
        found.append([confinement._own_cache(root / place, root) for place in places])
    one, two = found
    assert one[:3] == two[:3]
    assert one[3] != two[3]
    assert len({*one, *two}) == 5
