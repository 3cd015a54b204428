"""The pictures of the site: what methods draw of test frames, and how far they are off."""

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


def write_extremes(
    folder: Path,
    sources: Sequence[tuple[Entry, ResultsSource]],
    captures: Mapping[str, Capture],
) -> dict[str, list[dict[str, Any]]]:
    """Draw the best and the worst test frame of every capture, by PSNR, for each entry by its name.

    Each item is one capture: `capture`, and `best` and `worst` with `frame`, `truth` and what a
    shot of `write_gallery` has. Frames that failed have no picture and are left out.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    for entry, source in sources:
        for result in source.results.captures:
            capture = captures.get(result.digest)
            drawn = [frame for frame in result.frames if frame.failure is None]
            if capture is None or not drawn:
                continue
            order = sorted(drawn, key=lambda frame: (-frame.scores["psnr"], frame.frame))
            pair: dict[str, Any] = {"capture": capture.info.id}
            for name, frame in (("best", order[0].frame), ("worst", order[-1].frame)):
                truth = _Truth(folder, capture, frame)
                if shot := truth.shot(entry, source, result):
                    pair[name] = {**shot, "frame": frame, "truth": truth.address}
            if {"best", "worst"} <= pair.keys():
                found.setdefault(entry.name, []).append(pair)
    return found


def _scenes(
    folder: Path,
    capture: Capture,
    name: str,
    found: Sequence[tuple[Entry, ResultsSource, CaptureResult]],
    titles: Mapping[str, str],
) -> list[dict[str, Any]]:
    common = sorted(set.intersection(*({item.frame for item in row.frames} for _, _, row in found)))
    scenes = []
    for frame in (common[index] for index in evenly(len(common), FRAMES)):
        truth = _Truth(folder, capture, frame)
        shots = []
        for entry, source, result in found:
            if shot := truth.shot(entry, source, result):
                shots.append({**shot, "title": titles[entry.name]})
        if shots:
            scene = {"capture": name, "frame": frame, "truth": truth.address, "shots": shots}
            scenes.append(scene)
    return scenes


class _Truth:
    """The truth of one frame in the site, next to which predictions of it are drawn."""

    def __init__(self, folder: Path, capture: Capture, frame: int) -> None:
        self.folder, self.frame, self.target = folder, frame, capture.frame(frame)
        mask, exact = capture.scoring_mask(frame)
        self.region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        self.box = square_around(self.region)
        # The name of a folder is made of a digest: a capture's own id comes from outside.
        self.place = f"pictures/{sha256_json(capture.info.to_json())[:12]}"
        self.address = self._draw(f"{frame}-truth", self.target)

    def shot(
        self, entry: Entry, source: ResultsSource, result: CaptureResult
    ) -> dict[str, Any] | None:
        """Draw what an entry predicts and its error; None where its pixels are not there."""
        predictions = source.place(result.id, "predictions")
        if predictions is None:
            return None
        height, width = self.target.shape[:2]
        pixels = read_prediction(predictions, self.frame, (height, width)).pixels
        if pixels is None:
            return None
        name = f"{self.frame}-{digest(entry.results)[:12]}"
        error = error_map(pixels, self.target, self.region)
        return {
            "entry": entry.name,
            "picture": self._draw(name, pixels),
            "error": self._draw(f"{name}-e", error, masked=False),
            "psnr": next(one.scores["psnr"] for one in result.frames if one.frame == self.frame),
        }

    def _draw(self, name: str, image: np.ndarray, *, masked: bool = True) -> str:
        """Write a picture that is not there yet; returns its address within the site."""
        address = f"{self.place}/{name}.jpg"
        if not (self.folder / address).is_file():
            shown = np.where(self.region[..., None], image, 0) if masked else image
            (self.folder / self.place).mkdir(parents=True, exist_ok=True)
            _write(self.folder / address, shown[self.box])
        return address


def _write(path: Path, image: np.ndarray) -> None:
    """Write a JPEG; the folder is a temporary one, so that a half of it is never seen."""
    shown = cv2.cvtColor(fitted(np.ascontiguousarray(image), EDGE), cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    path.write_bytes(data.tobytes())
