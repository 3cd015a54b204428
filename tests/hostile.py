"""What tries what it must not: methods that are one script, and a pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from small_methods import SCRIPT, write_manifest


def folder_of(path: Path) -> Path:
    """Make a folder."""
    path.mkdir(exist_ok=True)
    return path


def hostile_method(folder: Path, script: str) -> Path:
    """Write a method directory whose program is the script."""
    folder_of(folder)
    (folder / "run.py").write_text("import json, os, pathlib, subprocess, sys, time\n" + script)
    write_manifest(folder, "hostile", SCRIPT)
    return folder


class Exploit:
    """Pickled, it asks for a call that leaves a file behind."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.marker,)
