"""PlayCanvas' splat-transform as an independent reader and writer of Gaussians.

It is kept in the toolkit's cache, and tests that need it are skipped where neither it nor a
registry of npm is there. Its SPZ codec is the authors' own.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from benchmarks.patience import run
from hwp_bench.base.files import cache_root
from hwp_bench.base.folders import exclusive

#: The versions that the tests were written for.
PACKAGES = ("@playcanvas/splat-transform@2.7.1", "gltf-validator@2.0.0-dev.3.10")


def node_packages() -> Path:
    """The folder with the packages, installed on first use."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node or npm is not here")
    folder = cache_root() / "tests" / "node-1"
    done = folder / "done"
    with exclusive(folder, wait=True):
        if not done.exists():
            folder.mkdir(parents=True, exist_ok=True)
            words = ["npm", "install", "--silent", "--ignore-scripts", "--prefix", str(folder)]
            made = run([*words, *PACKAGES])
            if made.returncode != 0:
                pytest.skip(f"npm cannot install {' '.join(PACKAGES)}: {made.stderr[-200:]}")
            done.touch()
    return folder / "node_modules"


def transform(source: Path, target: Path, *options: str) -> Path:
    """Let splat-transform read one file and write another."""
    program = node_packages() / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    words = ["node", str(program), "--quiet", "--overwrite", *options, str(source), str(target)]
    run(words).check_returncode()
    return target


def validation_errors(path: Path) -> list[str]:
    """What the Khronos validator calls errors in a glTF file."""
    script = (
        "const v=require('gltf-validator'),fs=require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))"
        ".then(r=>console.log(JSON.stringify(r.issues.messages.filter(m=>m.severity===0))))"
    )
    made = run(["node", "-e", script, str(path.resolve())], cwd=node_packages().parent)
    made.check_returncode()
    import json

    return [f"{one['code']}: {one['message']}" for one in json.loads(made.stdout)]
