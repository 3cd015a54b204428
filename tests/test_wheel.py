"""An installed wheel works outside of the checkout. Oracles: its file list, and its programs."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.slow


def run(*words: str | Path, cwd: Path) -> str:
    """Run a program without this checkout on its path; return its standard output."""
    hidden = ("PYTHONPATH", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(
        [str(word) for word in words], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation")
    run(*pip, "--no-index", "-w", folder, ROOT, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def programs(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of a new environment with the wheel, and the packages that run these tests."""
    home = tmp_path_factory.mktemp("environment")
    venv.create(home, symlinks=True)
    python = home / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps")
    run(*pip, "--no-index", wheel, cwd=home)
    (site,) = home.glob("lib/python*/site-packages")
    # A path in a `.pth` file adds the packages there, but not their own `.pth` files: an editable
    # install of this checkout stays out.
    shared = [path for path in sys.path if path.endswith("site-packages")]
    (site / "shared.pth").write_text("\n".join(shared) + "\n")
    return python.parent


def test_a_wheel_has_the_two_packages_and_their_data(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"hwp_bench", "wildghand"}
    assert len(tops) == 3
    data = "hwp_bench/_data"
    for name in (
        "hwp_bench/py.typed",
        "wildghand/py.typed",
        "wildghand/method.toml",
        f"{data}/baselines/network-scratch/method.toml",
        f"{data}/baselines/plain/method.toml",
        f"{data}/baselines/plain/plain_fit/method.py",
        f"{data}/leaderboard/published.json",
        f"{data}/splits/hwp-v1.json",
        f"{data}/templates/mean/my_method.py",
    ):
        assert name in names
    shipped = {path.relative_to(ROOT).as_posix() for path in _data_files()}
    assert len(shipped) > 20
    assert shipped - names == set()
    assert not any("__pycache__" in name for name in names)


def _data_files() -> list[Path]:
    """Every file of the two packages that is not Python: scenes, templates, priors, pages."""
    return [
        path
        for package in ("hwp_bench", "wildghand")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    ]


def test_its_programs_run_outside_of_the_checkout(programs: Path, tmp_path: Path) -> None:
    assert "evaluate" in run(programs / "hwp-bench", "--help", cwd=tmp_path)
    assert "fit" in run(programs / "wildghand", "--help", cwd=tmp_path)
    methods = run(programs / "hwp-bench", "list", "methods", cwd=tmp_path)
    for name in ("plain", "network-scratch", "wildghand"):
        assert name in methods
    where = "import hwp_bench, wildghand; print(hwp_bench.__file__, wildghand.__file__)"
    for place in run(programs / "python", "-c", where, cwd=tmp_path).split():
        assert Path(place).is_relative_to(programs.parent)


def test_the_shipped_baseline_can_be_loaded_from_it(programs: Path, tmp_path: Path) -> None:
    code = (
        "from hwp_bench.methods import find_method, read_manifest\n"
        "from hwp_bench.run.worker import load_entry\n"
        "for name in ('plain', 'baselines/plain', 'network-scratch', 'wildghand'):\n"
        "    manifest = read_manifest(find_method(name))\n"
        "    print(load_entry(manifest.root, manifest.entry.python).__name__)\n"
    )
    names = run(programs / "python", "-c", code, cwd=tmp_path).split()
    assert names == ["PlainMethod", "PlainMethod", "NetworkMethod", "WildGHandMethod"]
