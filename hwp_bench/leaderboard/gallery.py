"""The gallery of the site: what each method draws of a few test frames, and how far it is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hwp_bench.base.arrays import evenly
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


def write_gallery(
    folder: Path,
    sources: Sequence[tuple[Entry, ResultsSource]],
    captures: Mapping[str, Capture],
    titles: Mapping[str, str],
) -> list[dict[str, Any]]:
    """Draw every method on a few test frames of every capture, on the scored pixels.

    Nobody chooses the frames: they are evenly spread over the test clip. A scene is one frame:
    `capture` (with the suite where several have one of this name), `frame`, `truth`, and `shots`,
    the best method of the suite first. Pictures are addresses within the site.
    """
    by_capture: dict[tuple[str, str], list[tuple[Entry, ResultsSource, CaptureResult]]] = {}
    for entry, source in sorted(sources, key=lambda pair: -pair[0].results.scores["psnr"]):
        for result in source.results.captures:
            if result.digest in captures:
                key = (source.results.suite, result.digest)
                by_capture.setdefault(key, []).append((entry, source, result))

    def place(key: tuple[str, str]) -> tuple[int, int, str]:
        # `capture10` comes after `capture9`.
        identifier = captures[key[1]].info.id
        return SUITES.index(key[0]), len(identifier), identifier

    order = sorted(by_capture, key=place)
    ids = [captures[data].info.id for _, data in order]
    scenes = []
    for (suite, data), name in zip(order, ids, strict=True):
        title = f"{name} of {suite}" if ids.count(name) > 1 else name
        scenes += _scenes(folder, captures[data], title, by_capture[suite, data], titles)
    return scenes


def _scenes(
    folder: Path,
    capture: Capture,
    name: str,
    found: Sequence[tuple[Entry, ResultsSource, CaptureResult]],
    titles: Mapping[str, str],
) -> list[dict[str, Any]]:
    common = sorted(set.intersection(*({item.frame for item in row.frames} for _, _, row in found)))
    # The name of a folder is made of a digest: a capture's own id comes from outside.
    place = f"pictures/{sha256_json(capture.info.to_json())[:12]}"
    (folder / place).mkdir(parents=True, exist_ok=True)
    scenes = []
    for frame in (common[index] for index in evenly(len(common), FRAMES)):
        target = capture.frame(frame)
        mask, exact = capture.scoring_mask(frame)
        region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        box = square_around(region)
        truth = f"{place}/{frame}-truth.jpg"
        _write(folder / truth, np.where(region[..., None], target, 0)[box])
        shots = []
        for entry, source, result in found:
            predictions = source.place(result.id, "predictions")
            if predictions is None:
                continue
            pixels = read_prediction(predictions, frame, capture.size).pixels
            if pixels is None:
                continue
            own = f"{place}/{frame}-{digest(entry.results)[:12]}"
            picture, error = f"{own}.jpg", f"{own}-e.jpg"
            _write(folder / picture, np.where(region[..., None], pixels, 0)[box])
            _write(folder / error, error_map(pixels, target, region)[box])
            psnr = next(item.scores["psnr"] for item in result.frames if item.frame == frame)
            title = titles[entry.name]
            shot = {"entry": entry.name, "title": title, "picture": picture, "error": error}
            shots.append({**shot, "psnr": psnr})
        if shots:
            scenes.append({"capture": name, "frame": frame, "truth": truth, "shots": shots})
    return scenes


def _write(path: Path, image: np.ndarray) -> None:
    """Write a JPEG; the folder is a temporary one, so that a half of it is never seen."""
    shown = cv2.cvtColor(fitted(np.ascontiguousarray(image), EDGE), cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    path.write_bytes(data.tobytes())
