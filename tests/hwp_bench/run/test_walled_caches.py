"""What a method leaves reaches no other run, and no other program.

Oracle: what the next run finds, and the files that the test looks at outside.
"""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path

import pytest
from hostile import folder_of, hostile_method

from hwp_bench.base.folders import open_up
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.run.runner import run_method
from hwp_bench.run.sandbox.confinement import Confinement

MODES = ("required", "none")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="process control is Linux's")

LEAVE = """
found = []
for variable in ("HWP_CACHE", "NUMBA_CACHE_DIR", "HWP_KERNELS"):
    folder = os.environ[variable]
    for top, _, files in os.walk(folder):
        found += [name for name in files if "left" in name]
    try:
        os.makedirs(folder, exist_ok=True)
        pathlib.Path(folder, "left.code").write_text("code of a method")
    except OSError:
        pass
print(json.dumps({"found": found}))
"""


@pytest.mark.parametrize("mode", MODES)
def test_a_run_finds_nothing_of_another(
    attack, tmp_path: Path, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither of another method in the same folder, nor of its own earlier run."""
    toolkit = tmp_path / "toolkit"
    monkeypatch.setenv("HWP_CACHE", str(toolkit))
    for script in (LEAVE, LEAVE, LEAVE + "# another method\n"):
        _, said = attack(script, mode)
        assert said["found"] == []
        # Without walls a method may write what its user may; the place of code is named to it.
        if mode == "required":
            assert not list(toolkit.rglob("*left*"))
        for path in toolkit.rglob("*left*"):
            path.unlink()
    assert sorted(path.name for path in (tmp_path / "output").iterdir()) == ["log.txt"]


@pytest.mark.parametrize("mode", MODES)
def test_links_in_the_place_of_a_cache_lead_nowhere(attack, tmp_path: Path, mode: str) -> None:
    """Caches are removed after a run: what a link leads to must stay as it was."""
    mine = folder_of(tmp_path / "mine")
    (mine / "notes").write_text("mine")
    (mine / "link").symlink_to("notes")
    mine.chmod(0o755)
    script = f"""
import shutil
for name in ("cache", "home"):
    place = os.path.join(sys.argv[2], name)
    shutil.rmtree(place, ignore_errors=True)
    os.symlink({str(mine)!r}, place)
print("{{}}")
"""
    attack(script, mode)
    assert sorted(path.name for path in mine.iterdir()) == ["link", "notes"]
    assert stat.S_IMODE(mine.stat().st_mode) == 0o755
    assert not (tmp_path / "output" / "cache").is_symlink()


CALL = """
import numpy as np
from hwp_bench.metrics.pixels import similarity
row = np.ones(4)
similarity((row, row), (row, row), row.copy(), (0.1, 0.1, 1.0))
print("called")
"""
POISON = """
import hashlib, pickle
from hwp_bench.base import kernels
class Poison:
    def __reduce__(self):
        return print, ("POISONED",)
def save(self, sig, data):
    content = pickle.dumps(Poison())
    name = self._name(self._key(sig, data.codegen))
    digest = hashlib.sha256(content).digest()
    print("left", kernels.write_private(kernels.code_folder() / name, digest + content))
kernels.MachineCode.save_overload = save
"""


def test_kernels_of_one_method_are_never_run_in_another(
    tmp_path: Path, namespaces: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The audit's attack: a pickle that a method left ran in the method that took its place."""
    if not namespaces:
        pytest.skip("no user namespaces on this machine")
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "toolkit"))
    said = []
    for script in (POISON + CALL, CALL):
        method = hostile_method(tmp_path / "slot", script)
        request, output = folder_of(tmp_path / "request"), tmp_path / "output"
        walls = Confinement("required")
        run_method(read_manifest(method), "tiny", request, output, confinement=walls)
        said.append((output / "log.txt").read_text().split())
    assert said == [["left", "True", "called"], ["called"]]


def test_files_that_give_rights_do_not_survive(attack, tmp_path: Path) -> None:
    """Set-user-id and set-group-id, by every call that sets a mode, in every folder it may write.

    Inside, the modes are refused or left away; outside, `open_up` takes them.
    """
    script = """
import ctypes, stat
libc = ctypes.CDLL(None, use_errno=True)
folders = [sys.argv[2], os.environ["HWP_CACHE"], os.environ["HOME"], "/tmp"]
seen = []
for folder in folders:
    here = os.path.join(folder, "tool")
    for mode in (0o4755, 0o2755, 0o6755):
        made = [(f"{here}-open", lambda path: os.close(os.open(path, os.O_CREAT | 1, mode))),
                (f"{here}-mknod", lambda path: os.mknod(path, mode | stat.S_IFREG)),
                (f"{here}-creat", lambda path: libc.creat(path.encode(), mode)),
                (f"{here}-chmod", lambda path: (open(path, "w"), os.chmod(path, mode))),
                (f"{here}-fchmod", lambda path: os.fchmod(os.open(path, os.O_CREAT | 1), mode)),
                (f"{here}-at", lambda path: (open(path, "w"), libc.fchmodat(-100, path.encode(),
                                                                            mode, 0)))]
        for path, make in made:
            try:
                make(path)
            except OSError:
                pass
            if os.path.exists(path):
                seen.append(os.stat(path).st_mode & 0o6000)
                os.rename(path, f"{path}-{mode:o}-{len(seen)}")
print(json.dumps({"seen": sorted(set(seen)), "tried": len(seen)}))
"""
    _, said = attack(script)
    assert said["seen"] == [0]
    assert said["tried"] >= 4 * 3 * 3
    for path in (tmp_path / "output").rglob("*"):
        assert not path.stat().st_mode & (stat.S_ISUID | stat.S_ISGID)


def test_what_a_folder_is_left_with_gives_no_rights(tmp_path: Path) -> None:
    for mode, name in ((0o6755, "sh"), (0o4111, "closed"), (0o644, "plain")):
        (tmp_path / name).touch()
        (tmp_path / name).chmod(mode)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder").chmod(0o3777)
    open_up(tmp_path)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert modes == {"sh": 0o755, "closed": 0o600, "plain": 0o644, "folder": 0o700}
    assert os.stat(tmp_path).st_mode & 0o7777 == 0o700
