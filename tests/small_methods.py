"""Method directories for tests."""

from __future__ import annotations

from pathlib import Path

#: Entries: a script of the method, run by our Python; predictions that are there already.
SCRIPT = 'command = ["{python}", "{method}/run.py", "{request}", "{output}"]'
SUBMISSION = 'predictions = "predictions"'


def write_manifest(folder: Path, name: str, entry: str, more: str = "") -> Path:
    """Write the `method.toml` of a method; `more` are further tables."""
    folder.mkdir(parents=True, exist_ok=True)
    text = f'schema = "hwp-method/1"\nname = "{name}"\n[entry]\n{entry}\n{more}'
    (folder / "method.toml").write_text(text)
    return folder
