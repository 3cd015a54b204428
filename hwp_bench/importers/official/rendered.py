"""Frames that the authors' code has drawn, as predictions that the benchmark scores.

Their test run (`--run_val`) writes below `EXPERIMENTS/NAME/images_all/-1/render`, for the position
F of each test frame in `output.pkl`:

- `frameF_viewF_pred_PSNR_lrN.png`: the drawing, 256 x 256 px, 8-bit RGB over black,
- `frameF_viewF_pred_PSNR_lrN_bbox.png`: the same, black outside the hands' box,
- `frameF_viewF_gt.png`: the crop of the video that it was compared with.

`pred` and `gt` next to `render` hold cut-outs of varying size, from which nothing can be scored.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadInput, HwpError, UsageError, bounded
from hwp_bench.base.files import atomic_folder, atomic_write
from hwp_bench.base.images import read_rgba, write_image
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.capture.splits import Split
from hwp_bench.methods.manifest import MANIFEST, SCHEMA, read_manifest
from hwp_bench.metrics.pixels import decibels

#: Folder of the predictions in the method directory that is made.
PREDICTIONS = "predictions"
#: Most files and folders that are looked at, and the deepest folder.
MAX_FILES, MAX_DEPTH = 200_000, 6
#: A background whose brightest channel is above this is not black.
DARK = 8
#: Ground truth that is farther than this from the capture's frames is another crop, dB.
SAME_CROP = 30.0

_DRAWING = re.compile(r"frame(\d{1,7})_view\d{1,7}_pred_[^/]{1,40}?_lr\d+(_bbox)?\.png")
_TRUTH = re.compile(r"frame(\d{1,7})_view\d{1,7}_gt\.png")


@dataclass
class RenderedImport:
    """The outcome of importing the frames of one capture."""

    #: Id of the capture.
    capture: str
    #: Frames that were taken.
    taken: list[int] = field(default_factory=list)
    #: Test frames of which there is no drawing.
    missing: list[int] = field(default_factory=list)
    #: Why a drawing was not taken, by frame; these count as missing too.
    refused: dict[int, str] = field(default_factory=dict)
    #: Frames whose alpha channel was applied over black.
    with_alpha: list[int] = field(default_factory=list)
    #: Frames whose background is not black.
    other_background: list[int] = field(default_factory=list)
    #: Mean PSNR between their ground truth and the capture's frames on the scored mask, dB; None
    #: where no ground truth lies next to the drawings.
    truth_db: float | None = None

    def warnings(self) -> list[str]:
        """Return the sentences that a person should read before believing the scores."""
        found = []
        if self.missing:
            found.append(f"test frames without a drawing get the penalty: {bounded(self.missing)}")
        found += [f"frame {frame} was not taken: {text}" for frame, text in self.refused.items()]
        if self.with_alpha:
            found.append(f"drawn with alpha, laid over black: frames {bounded(self.with_alpha)}")
        if self.other_background:
            found.append(
                "the background is not black, and shows through where the hand is not opaque: "
                f"frames {bounded(self.other_background)}"
            )
        if self.truth_db is not None and self.truth_db < SAME_CROP:
            found.append(
                f"their ground truth is only {self.truth_db:.1f} dB from the capture's frames: "
                "another crop or other frames. Their loader's crop is that of `data import "
                "wildghand --official-compat`"
            )
        return found


def import_rendered(
    folder: str | os.PathLike[str],
    capture: Capture,
    split: Split,
    out: str | os.PathLike[str],
    *,
    name: str = "authors-code",
    overwrite: bool = False,
) -> RenderedImport:
    """Make predictions for a capture from renderings of the authors' code.

    Args:
        folder: their experiment's folder, or one in it down to `render`.
        capture: the frames' positions in it are those of `output.pkl`.
        split: which frames are wanted.
        out: a method directory of predictions; captures are added to one that is there.
        name: of the method.
        overwrite: replace the capture's predictions in it.

    Raises:
        BadInput: the folder holds no drawings or several runs, a frame is drawn twice, or no
            drawing can be taken.
        UsageError: `out` is another method.
    """
    drawings, truths = _find(Path(folder))
    _check_method(Path(out), name)
    info = capture.info
    made = RenderedImport(info.id)
    wanted = split.test.tolist()
    made.missing = [frame for frame in wanted if frame not in drawings]
    far: list[float] = []
    target = Path(out) / PREDICTIONS / info.id
    with atomic_folder(target, overwrite=overwrite, flag="--overwrite") as root:
        for frame in wanted:
            if frame not in drawings:
                continue
            try:
                pixels = _read(drawings[frame], capture, frame, made)
            except HwpError as error:
                made.refused[frame] = f"{drawings[frame].name} {error.problem}"
                continue
            write_image(root / frame_name(frame), pixels)
            made.taken.append(frame)
            if frame in truths:
                far.append(_squared_error(truths[frame], capture, frame))
        if not made.taken:
            first = next(iter(made.refused.values()), "it has none of the test frames")
            raise BadInput(
                f"holds no drawing that fits {info.id}: {first}",
                where=folder,
                remedy=f"Wanted are frames {wanted[0]} to {wanted[-1]}, "
                f"{info.width}x{info.height} px.",
            )
    if far:
        made.truth_db = decibels(float(np.mean(far)))
    if not (Path(out) / MANIFEST).is_file():
        atomic_write(Path(out) / MANIFEST, _manifest(name))
    return made


def _find(folder: Path) -> tuple[dict[int, Path], dict[int, Path]]:
    """The drawings and the ground truth of a run, by frame."""
    if not folder.is_dir():
        raise BadInput("is not a folder", where=folder)
    drawn: dict[tuple[int, bool], Path] = {}
    truths: dict[int, Path] = {}
    places: set[Path] = set()
    for path in _files(folder):
        if match := _DRAWING.fullmatch(path.name):
            key = int(match[1]), match[2] is not None
            places.add(path.parent)
            if len(places) > 1:
                raise BadInput(
                    f"holds several runs: {bounded(sorted(map(str, places)))}",
                    where=folder,
                    remedy="Give the folder `render` of one of them.",
                )
            if key in drawn:
                raise BadInput(
                    f"frame {key[0]} is drawn twice: {drawn[key].name} and {path.name}",
                    where=path.parent,
                    remedy="Remove the files of the run that does not count.",
                )
            drawn[key] = path
        elif match := _TRUTH.fullmatch(path.name):
            truths[int(match[1])] = path
    if not drawn:
        raise BadInput(
            "holds no frameF_viewF_pred_PSNR_lrN.png, also not in its subfolders",
            where=folder,
            remedy="Give what the authors' code wrote with --run_val: EXPERIMENTS/NAME, or the "
            "folder `render` in it.",
        )
    # Without the box first: it cuts off what the hands' box misses.
    frames = sorted({frame for frame, _ in drawn})
    return {f: drawn.get((f, False)) or drawn[f, True] for f in frames}, {
        frame: path for frame, path in truths.items() if path.parent in places
    }


def _files(folder: Path) -> Iterator[Path]:
    """Files below a folder, no links; a bounded number."""
    seen, waiting = 0, [(folder, 0)]
    while waiting:
        place, depth = waiting.pop()
        with os.scandir(place) as entries:
            for entry in sorted(entries, key=lambda item: item.name):
                seen += 1
                if seen > MAX_FILES:
                    raise BadInput(
                        f"holds more than {MAX_FILES} files",
                        where=folder,
                        remedy="Give the folder `render`.",
                    )
                if entry.is_dir(follow_symlinks=False) and depth < MAX_DEPTH:
                    waiting.append((Path(entry.path), depth + 1))
                elif entry.is_file(follow_symlinks=False):
                    yield Path(entry.path)


def _read(path: Path, capture: Capture, frame: int, made: RenderedImport) -> np.ndarray:
    """A drawing over black, (H, W, 3) uint8; what is odd about it is noted."""
    pixels = read_rgba(path, capture.size)
    colors, alpha = pixels[..., :3], pixels[..., 3:]
    if (alpha < 255).any():
        made.with_alpha.append(frame)
        colors = np.rint(colors * (alpha / 255.0)).astype(np.uint8)
    mask, _ = capture.scoring_mask(frame)
    around = colors[mask == 0]
    if len(around) and np.median(around, axis=0).max() > DARK:
        made.other_background.append(frame)
    return colors


def _squared_error(path: Path, capture: Capture, frame: int) -> float:
    """Mean squared error of a ground truth on the hand; 1 where it cannot be read or compared."""
    try:
        theirs = read_rgba(path, capture.size)[..., :3]
    except HwpError:
        return 1.0
    mask, _ = capture.scoring_mask(frame)
    difference = (theirs / 255.0 - capture.frame(frame) / 255.0)[mask > 127]
    return float((difference**2).mean()) if difference.size else 0.0


def _check_method(out: Path, name: str) -> None:
    if not (out / MANIFEST).is_file():
        # An import that failed may have left the folder of the predictions.
        if out.is_dir() and any(path.name != PREDICTIONS for path in out.iterdir()):
            raise UsageError(f"is not empty, and has no {MANIFEST}", where=out)
        return
    manifest = read_manifest(out)
    if manifest.entry.predictions != PREDICTIONS or manifest.name != name:
        raise UsageError(
            f"is the method {manifest.name!r}",
            where=out,
            remedy=f"Choose another folder, or --name {manifest.name} where it is predictions.",
        )


def _manifest(name: str) -> str:
    text = json.dumps(name)
    return (
        f'schema = "{SCHEMA}"\nname = {text}\ntitle = "{name}"\n'
        'description = "Frames drawn by the authors\' code."\n'
        'url = "https://github.com/XuanHuang0/WildGHand"\n'
        # As the paper says of its network.
        'training = { public = ["InterHand2.6M"] }\n\n'
        f'[entry]\npredictions = "{PREDICTIONS}"\n'
    )
