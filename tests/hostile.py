"""Methods that are one script, which tries what it must not."""

from __future__ import annotations

from pathlib import Path


def folder_of(path: Path) -> Path:
    """Make a folder."""
    path.mkdir(exist_ok=True)
    return path


def hostile_method(folder: Path, script: str) -> Path:
    """Write a method directory whose program is the script."""
    folder_of(folder)
    (folder / "run.py").write_text("import json, os, pathlib, subprocess, sys, time\n" + script)
    (folder / "method.toml").write_text(
        'schema = "hwp-method/1"\nname = "hostile"\n[entry]\n'
        'command = ["{python}", "{method}/run.py", "{request}", "{output}"]\n'
    )
    return folder
