"""What two evaluations must have in common wherever they ran: everything but their timings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hwp_bench.base.files import sha256_file

#: Fields that tell how long something took, how much memory it had, and when.
TIMINGS = ("seconds", "peak_memory", "started", "environment", "isolation")


def contents(folder: Path) -> dict[str, Any]:
    """Results by path without timings, and the digest of every predicted frame."""
    found: dict[str, Any] = {}
    for path in sorted([*folder.rglob("result.json"), *folder.rglob("results.json")]):
        content = json.loads(path.read_text())
        if path.name == "results.json":
            del content["digest"]  # of everything, timings too
        found[str(path.relative_to(folder))] = _without(content)
    for path in sorted(folder.rglob("predictions/*.png")):
        found[str(path.relative_to(folder))] = sha256_file(path)
    assert found
    return found


def _without(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without(v) for k, v in value.items() if not k.endswith(TIMINGS)}
    return [_without(item) for item in value] if isinstance(value, list) else value
