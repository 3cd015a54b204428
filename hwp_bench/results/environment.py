"""The environment of a result: versions, processor, system."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from typing import Any

from hwp_bench.base import packages
from hwp_bench.base.files import files_digest
from hwp_bench.results.walls import NEW_CACHES

#: Packages whose version can move a number.
PACKAGES = (
    "numpy",
    "torch",
    "numba",
    "opencv-contrib-python-headless",
    "scikit-image",
    "OpenImageIO",
    "scipy",
    "trimesh",
    "embreex",
    "gsplat",
    "lpips",
)


def environment() -> dict[str, Any]:
    """Return the versions, the processor and the system; no host name and no path.

    `code` is the digest of the toolkit's own modules, which a version number alone does not tell
    while it is being developed. `caches` says what caches the methods began with.
    """
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "packages": versions,
        "code": code_digest(),
        "caches": NEW_CACHES,
    }


def code_digest() -> str:
    """Return the SHA-256 (hex) of the toolkit's own modules: names and contents."""
    root = packages.PACKAGES / "hwp_bench"
    # The shipped methods lie in `_data` in a wheel and elsewhere in a checkout.
    shipped = root / "_data"
    modules = (path for path in root.rglob("*.py") if not path.is_relative_to(shipped))
    return files_digest(root, modules)


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as stream:
            for line in stream:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"
