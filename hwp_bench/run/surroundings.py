"""What a method's process finds around it: environment variables, and files in its sandbox."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

from hwp_bench.base.files import cache_root
from hwp_bench.methods.manifest import MethodManifest
from hwp_bench.run.sandbox.confinement import Confinement
from hwp_bench.run.sandbox.places import visible_places
from hwp_bench.run.sandbox.root import Place

#: Environment variables that a method's process inherits in any case.
ALWAYS = (
    "CUDA_VISIBLE_DEVICES",
    "LANG",
    "LC_ALL",
    "LD_LIBRARY_PATH",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "PATH",
    "PYTHONPATH",
    "VIRTUAL_ENV",
)
#: Those that name folders, which are there only where it runs without a sandbox.
FOLDERS = ("HOME", "HWP_CACHE", "NUMBA_CACHE_DIR", "TMPDIR", "TORCH_HOME", "XDG_CACHE_HOME")


def inherited() -> dict[str, str]:
    """Return the environment of a method that runs without a sandbox."""
    return _taken((*ALWAYS, *FOLDERS))


def apart(
    manifest: MethodManifest,
    command: Sequence[str],
    request: Path,
    output: Path,
    wanted: Confinement,
) -> tuple[dict[str, str], list[Place]]:
    """Return the environment of a method in a sandbox, and what it sees of the file system.

    It may write to its output folder, and to a cache that it shares only with other runs of the
    same method: compiled code must survive a run, and must never reach another program.

    Args:
        manifest: the method.
        command: its words; the first is the program.
        request: what it is given.
        output: its work folder.
        wanted: what else is shown or hidden.
    """
    home = output / "home"
    home.mkdir()
    cache = _own_cache(manifest, output)
    environment = {
        **_taken(ALWAYS),
        "HOME": str(home.resolve()),
        "HWP_CACHE": str(cache),
        "NUMBA_CACHE_DIR": str(cache / "numba"),
    }
    weights = _torch_home()
    if weights.is_dir():
        environment["TORCH_HOME"] = str(weights)
    libraries = [Path(entry) for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    places = visible_places(
        read=[manifest.root, request, weights, *_absolute(libraries), *wanted.exposed],
        write=[output, cache],
        hidden=wanted.hidden,
        program=command[0],
    )
    return environment, places


def _taken(names: Sequence[str]) -> dict[str, str]:
    return {name: os.environ[name] for name in names if name in os.environ}


def _absolute(paths: Sequence[Path]) -> list[Path]:
    return [path for path in paths if path.is_absolute()]


def _torch_home() -> Path:
    """Folder of torch's downloaded weights, which methods read and never write."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return Path(os.environ.get("TORCH_HOME") or f"{cache}/torch").expanduser()


def _own_cache(manifest: MethodManifest, output: Path) -> Path:
    name = hashlib.sha256(os.fsencode(manifest.root.resolve())).hexdigest()[:16]
    cache = cache_root().absolute() / "methods" / name
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        cache = output.resolve() / "cache"
        cache.mkdir()
    return cache.resolve()


def hand_model_files(source: str) -> list[Path]:
    """Return the files of a hand model that a user brought, to be shown to a method.

    Args:
        source: what a capture says of its model: `anny`, `mano:PATH`, `mano-hd:PATH`.
    """
    kind, _, place = source.partition(":")
    path = Path(place)
    if not kind.startswith("mano") or not path.is_absolute():
        return []
    # Named one by one: a capture must not choose a folder that is then shown whole.
    folders = (path.parent,) if path.is_file() else (path, path / "models")
    names = (path.name, "MANO_RIGHT.pkl", "MANO_LEFT.pkl")
    files = [folder / name for folder in folders for name in names if name.endswith(".pkl")]
    return [file for file in files if file.is_file()]
