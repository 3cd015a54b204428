"""The pictures of the site: test frames, their truth, and what each method drew of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hwp_bench.base.drawing import error_map, fitted
from hwp_bench.base.files import sha256_json
from hwp_bench.capture import Capture
from hwp_bench.evaluation.artifacts import square_around
from hwp_bench.evaluation.scoring import read_prediction
from hwp_bench.leaderboard.entries import Entry, digest
from hwp_bench.leaderboard.rules import SUITES
from hwp_bench.metrics import HWP_V1
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import CaptureResult

#: Test frames of each capture that are shown at most, evenly spread.
FRAMES = 6
#: Edge of a picture, px.
EDGE = 384
#: Quality of JPEG; a picture of this edge takes some 12 kB.
QUALITY = 82


@dataclass(frozen=True)
class Shot:
    """The drawing of one frame by one method."""

    #: Name of the entry.
    entry: str
    #: Title of the method, with its budget.
    title: str
    #: The drawing and its error map, as addresses within the site.
    picture: str
    error: str
    #: PSNR of the frame, dB.
    psnr: float


@dataclass(frozen=True)
class Scene:
    """One test frame of one capture."""

    #: The capture's id, with the suite where several suites have one of this name.
    capture: str
    #: The frame's index.
    frame: int
    #: The truth, as an address within the site.
    truth: str
    #: Methods, the best of the suite first: not of the frame, whose scores stand with its pictures.
    shots: tuple[Shot, ...]


def write_gallery(
    folder: Path,
    sources: Sequence[tuple[Entry, ResultsSource]],
    captures: Mapping[str, Capture],
    titles: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Draw every method on a few test frames of every capture, on the scored pixels.

    Nobody chooses the frames: they are evenly spread over the test clip.

    Args:
        folder: of the site; pictures go into `pictures` within.
        sources: entries with the folders of their results.
        captures: by digest; others have no truth to show and are left out.
        titles: how a method is called in lists, by the name of its entry.

    Returns:
        `Scene`s as JSON values, in the order of the suites, the captures and frames.
    """
    by_capture: dict[tuple[str, str], list[tuple[Entry, ResultsSource, CaptureResult]]] = {}
    ranked = sorted(sources, key=lambda pair: -pair[0].results.scores["psnr"])
    for entry, source in ranked:
        for result in source.results.captures:
            if result.digest in captures:
                key = (source.results.suite, result.digest)
                by_capture.setdefault(key, []).append((entry, source, result))
    order = sorted(by_capture, key=lambda key: _place(key[0], captures[key[1]].info.id))
    ids = [captures[data].info.id for _, data in order]
    scenes = []
    for suite, data in order:
        capture = captures[data]
        several = ids.count(capture.info.id) > 1
        name = f"{capture.info.id} of {suite}" if several else capture.info.id
        scenes += _scenes(folder, capture, name, by_capture[suite, data], titles)
    return [asdict(scene) for scene in scenes]


def _place(suite: str, identifier: str) -> tuple[int, int, str]:
    """The place of a capture in lists: `capture10` comes after `capture9`."""
    return SUITES.index(suite), len(identifier), identifier


def _scenes(
    folder: Path,
    capture: Capture,
    name: str,
    found: Sequence[tuple[Entry, ResultsSource, CaptureResult]],
    titles: Mapping[str, str],
) -> list[Scene]:
    common = set.intersection(*({item.frame for item in row.frames} for _, _, row in found))
    # The name of a folder is made of a digest: a capture's own id comes from outside.
    place = f"pictures/{sha256_json(capture.info.to_json())[:12]}"
    (folder / place).mkdir(parents=True, exist_ok=True)
    scenes = []
    for frame in _spread(sorted(common)):
        target = capture.frame(frame)
        mask, exact = capture.scoring_mask(frame)
        region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        box = square_around(region)
        truth = f"{place}/{frame}-truth.jpg"
        _write(folder / truth, np.where(region[..., None], target, 0)[box])
        shots = []
        for entry, source, result in found:
            predictions = source.place(result.id, "predictions")
            pixels = None
            if predictions is not None:
                pixels = read_prediction(predictions, frame, capture.size).pixels
            if pixels is None:
                continue
            picture, error = (
                f"{place}/{frame}-{digest(entry.results)[:12]}{end}.jpg" for end in ("", "-e")
            )
            _write(folder / picture, np.where(region[..., None], pixels, 0)[box])
            _write(folder / error, error_map(pixels, target, region)[box])
            psnr = next(item.scores["psnr"] for item in result.frames if item.frame == frame)
            shots.append(Shot(entry.name, titles[entry.name], picture, error, psnr))
        if shots:
            scenes.append(Scene(name, frame, truth, tuple(shots)))
    return scenes


def _spread(frames: Sequence[int]) -> list[int]:
    """At most `FRAMES` of some frames, evenly spread, the first and the last among them."""
    if len(frames) <= FRAMES:
        return list(frames)
    return [frames[round(k * (len(frames) - 1) / (FRAMES - 1))] for k in range(FRAMES)]


def _write(path: Path, image: np.ndarray) -> None:
    """Write a JPEG; the folder is a temporary one, so that a half of it is never seen."""
    shown = cv2.cvtColor(fitted(np.ascontiguousarray(image), EDGE), cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    path.write_bytes(data.tobytes())
