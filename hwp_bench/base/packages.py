"""The folders of the toolkit's own packages and data, in a checkout and in an installed wheel."""

from __future__ import annotations

from pathlib import Path

from hwp_bench.base.errors import HwpError

#: Folder that holds the packages `hwp_bench` and `wildghand`.
PACKAGES = Path(__file__).resolve().parents[2]


def data_folder(name: str) -> Path:
    """Return a folder of data that ships with the toolkit.

    In an installed wheel it lies inside the package `hwp_bench`, in a checkout next to it.

    Args:
        name: `baselines`, `leaderboard` or `splits`.

    Raises:
        HwpError: it is in neither place: the installation is broken.
    """
    for folder in (PACKAGES / "hwp_bench" / "_data" / name, PACKAGES / name):
        if folder.is_dir():
            return folder
    raise HwpError(
        f"the data folder {name!r} of the toolkit is missing",
        where=PACKAGES,
        remedy="Install the toolkit again.",
    )
