"""Seconds of each stage of `wildghand fit VIDEO`, with and without `--quick`.

Run from the repository, on a machine with nothing else to do:
`python -m benchmarks.video_stages hand.mp4` makes the avatar both ways, each in a new folder and a
process of its own, as a person would. What it finds takes the place of the same video's and
machine's lines in `video_stages.jsonl`; `hwp-bench dev docs-results` writes the table of
docs/video.md from them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.ratio_store import origin
from hwp_bench.base.files import atomic_write

#: A JSON object for each way of each video.
LOG = Path(__file__).with_name("video_stages.jsonl")


def measure(video: Path, *, quick: bool) -> dict[str, Any]:
    """Make the avatar of a video; return the seconds of the command and of its stages."""
    program = "import sys; from wildghand.cli.main import main; sys.exit(main())"
    with tempfile.TemporaryDirectory() as folder:
        words = ["fit", str(video), "-o", f"{folder}/avatar", "--json", *["--quick"] * quick]
        began = time.monotonic()
        command = [sys.executable, "-c", program, *words]
        made = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        seconds = time.monotonic() - began
    facts = json.loads(made.stdout)
    return {
        "video": video.name,
        "quick": quick,
        "frames": facts["frames"],
        "seconds": round(seconds, 1),
        "stages": {one["name"]: round(one["seconds"], 1) for one in facts["stages"]},
        **origin(),
    }


def keep(found: list[dict[str, Any]], log: Path = LOG) -> None:
    """Write what was found, in place of older lines of the same video, way and machine."""
    lines = log.read_text("utf-8").splitlines() if log.is_file() else []
    new = set(map(_call, found))
    old = [one for one in map(json.loads, lines) if _call(one) not in new]
    text = "".join(json.dumps(one) + "\n" for one in (*old, *found))
    atomic_write(log, text.encode(), overwrite=True)


def _call(one: dict[str, Any]) -> tuple[str, bool, str]:
    return one["video"], one["quick"], one["machine"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video", type=Path)
    video = parser.parse_args().video
    found = [measure(video, quick=quick) for quick in (False, True)]
    keep(found)
    for one in found:
        print(json.dumps(one))


if __name__ == "__main__":
    main()
