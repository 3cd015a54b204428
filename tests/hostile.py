"""Methods that are one script, which tries what it must not."""

from __future__ import annotations

from pathlib import Path

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
