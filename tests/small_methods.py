"""Method directories for tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hwp_bench.base.images import write_image

#: Entries: a script of the method, run by our Python; predictions that are there already.
SCRIPT = 'command = ["{python}", "{method}/run.py", "{request}", "{output}"]'
SUBMISSION = 'predictions = "predictions"'


def write_manifest(folder: Path, name: str, entry: str, more: str = "") -> Path:
    """Write the `method.toml` of a method; `more` are further tables."""
    folder.mkdir(parents=True, exist_ok=True)
    text = f'schema = "hwp-method/1"\ntraining = "none"\nname = "{name}"\n[entry]\n{entry}\n{more}'
    (folder / "method.toml").write_text(text)
    return folder


def write_submission(folder: Path, images: Mapping[str, np.ndarray], name: str = "entry") -> Path:
    """Write predictions, each by its place such as `tiny/000018.png`, and their manifest."""
    for place, pixels in images.items():
        write_image(folder / "predictions" / place, pixels)
    return write_manifest(folder, name, SUBMISSION)
