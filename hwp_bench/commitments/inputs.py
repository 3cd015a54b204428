"""The inputs of a program of one's own: request folders to read, and a submission to fill."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.files import atomic_folder, atomic_write, refuse_existing
from hwp_bench.base.packages import data_folder
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import Split
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import MANIFEST as METHOD_MANIFEST
from hwp_bench.methods.request import write_request
from hwp_bench.methods.template import check_name, fill_template

#: Folders inside the inputs, and the page that explains them.
REQUESTS, SUBMISSION, PREDICTIONS, README = "requests", "submission", "predictions", "README.md"


@dataclass(frozen=True)
class Inputs:
    """The inputs that were written."""

    #: Folder of the request folders, one for each capture.
    requests: Path
    #: Method directory that the predictions go into.
    submission: Path
    #: Predicted frames that are wanted, by capture; free-view frames are not among them.
    wanted: Mapping[str, int]


def write_inputs(
    captures: Sequence[tuple[Capture, Split]],
    out: str | os.PathLike[str],
    *,
    name: str = "mine",
    score: str = "",
) -> Inputs:
    """Write what a program may see of captures, and the folder that its predictions go into."""
    check_place(out, name)
    with atomic_folder(out) as root:
        for capture, split in captures:
            write_request(root / REQUESTS / capture.info.id, capture, split, RunSettings({}))
            (root / SUBMISSION / PREDICTIONS / capture.info.id).mkdir(parents=True)
        manifest = data_folder("templates") / "predictions" / METHOD_MANIFEST
        atomic_write(root / SUBMISSION / METHOD_MANIFEST, fill_template(manifest, name))
        atomic_write(root / README, _readme(captures, score))
    folder = Path(out)
    wanted = {capture.info.id: len(split.test) for capture, split in captures}
    return Inputs(folder / REQUESTS, folder / SUBMISSION, wanted)


def check_place(out: str | os.PathLike[str], name: str) -> None:
    """Refuse what `write_inputs` would refuse, before captures are rendered for it."""
    refuse_existing(out)
    check_name(name, "--name")


def _readme(captures: Sequence[tuple[Capture, Split]], score: str) -> str:
    lines = [
        "# Inputs of a program of your own",
        "",
        f"`{REQUESTS}/CAPTURE/` is what a method sees: `frames/` and `masks/` of training and",
        "validation frames, `hands.npz` and `cameras.npz` of every frame, and `request.json` with",
        "the split. The frames under `split.test` are to be drawn.",
        "",
        f"Write `{SUBMISSION}/{PREDICTIONS}/CAPTURE/000123.png` for each of them: 8-bit RGB in the",
        "size of the capture, colour over black. Frames of the free-view clip, whose poses and",
        f"cameras are in `free/`, go to `{SUBMISSION}/{PREDICTIONS}/CAPTURE/free/000003.png`; they",
        "may be absent as a whole.",
        "",
        "| capture | size [px] | first frame to draw | last | free-view frames |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for capture, split in captures:
        info, clip = capture.info, capture.free_view
        free = 0 if clip is None else len(clip)
        first, last = int(split.test.min()), int(split.test.max())
        lines.append(f"| {info.id} | {info.width} x {info.height} | {first} | {last} | {free} |")
    if score:
        lines += ["", "Then:", "```sh", score, "```"]
    return "\n".join(lines) + "\n"
