"""What stays out of a method's sight although it lies in a folder that is shown.

The simulator, the scenes and the seeds of the suites are public, so a method that could import them
would render the test frames again. Runs and captures below a method's own folder hold true frames.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from glob import escape, glob
from pathlib import Path

from hwp_bench.base.errors import UsageError
from hwp_bench.methods.contents import is_foreign

#: Parts of `hwp_bench` that a method may import: all that methods which ship are built from. Any
#: other stays out of sight; those render, seal, score or rank test frames.
SHOWN_ROOMS = frozenset(
    {"_data", "analysis", "base", "capture", "cli", "hands", "importers", "methods", "metrics"}
    | {"report", "results", "run", "taxonomy", "tracking"}
)

#: Most folders of a method that are looked into.
MAX_FOLDERS = 20_000


def secluded_rooms(folders: Iterable[str]) -> list[str]:
    """Return the parts of every installed `hwp_bench` that methods do not see.

    Args:
        folders: places that are shown: packages, folders of packages, prefixes of environments.
    """
    found = []
    for folder in folders:
        above = [
            folder,
            os.path.dirname(folder),
            *glob(f"{escape(folder)}/lib*/python*/*-packages"),
        ]
        for place in above:
            package = os.path.join(place, "hwp_bench")
            # A name alone would hide somebody else's folder of that name.
            if os.path.isfile(os.path.join(package, "__init__.py")):
                found += _parts(package)
    return list(dict.fromkeys(found))


def _parts(package: str) -> list[str]:
    with os.scandir(package) as entries:
        return [
            entry.path
            for entry in entries
            # A link would have another place hidden.
            if entry.is_dir(follow_symlinks=False)
            and entry.name not in SHOWN_ROOMS | {"__pycache__"}
        ]


def foreign_folders(method: Path) -> list[str]:
    """Return the folders below a method's that do not belong to it: captures and outputs of runs.

    `is_foreign` knows them, as the digest of a method does. Links are not followed; inside walls
    they lead nowhere.

    Raises:
        UsageError: there are more than `MAX_FOLDERS` folders.
    """
    found = []
    for seen, (folder, folders, files) in enumerate(os.walk(method)):
        if seen == MAX_FOLDERS:
            raise UsageError(
                f"holds more than {MAX_FOLDERS} folders, too many to tell what is the method's",
                where=method,
                remedy="Keep the method in a folder of its own.",
            )
        own = folder == os.fspath(method)
        if not own and is_foreign(folder, files):
            found.append(folder)
            folders.clear()
    return found
