"""Scripts that run as methods, to try what a hostile one would."""

from __future__ import annotations

from pathlib import Path


def made_folder(path: Path) -> Path:
    path.mkdir(exist_ok=True)
    return path


def attack_method(folder: Path, script: str) -> Path:
    made_folder(folder)
    (folder / "run.py").write_text("import json, os, pathlib, subprocess, sys, time\n" + script)
    (folder / "method.toml").write_text(
        'schema = "hwp-method/1"\nname = "hostile"\n[entry]\n'
        'command = ["{python}", "{method}/run.py", "{request}", "{output}"]\n'
    )
    return folder
