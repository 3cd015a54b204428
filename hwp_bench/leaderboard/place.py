"""Where the leaderboard's data lie."""

from __future__ import annotations

from pathlib import Path

from hwp_bench.errors import HwpError


def leaderboard_folder() -> Path:
    """Return the folder that holds `published.json` and `entries/`.

    In an installed wheel it lies inside the package, in a checkout beside it.

    Raises:
        HwpError: neither is there: the installation is broken.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_data" / "leaderboard", package.parent / "leaderboard"):
        if folder.is_dir():
            return folder
    raise HwpError("the leaderboard's data are missing", remedy="Install the toolkit again.")
