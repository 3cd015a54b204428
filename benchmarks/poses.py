"""How far the poses that WildGHand believes in are from the true ones.

Run from the repository: `python -m benchmarks.poses CAPTURE...` corrects the given poses of
simulated captures as a fit does before its first step, and compares both with the truth, in all
frames and in those to predict. `--picture FILE` draws some of these, a row for each capture. The
name of a suite stands for its captures, which are rendered if they are not in the cache.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.tracker_errors import pose_error, rms
from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.images import write_image
from hwp_bench.base.tables import Cell, Column, Table, to_markdown
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands import HandParameters
from hwp_bench.hands.poses import posed_skeleton, rest_skeleton
from hwp_bench.sim.produce.capture import ensure_suite, suite_names
from wildghand.poses import believed_hands

#: Colours of the drawn hands, sRGB.
COLORS = {"true": (60, 220, 60), "given": (255, 60, 60), "believed": (70, 140, 255)}
# Edge of a drawn frame, px, and frames in a row.
_EDGE, _COLUMNS = 264, 6
# Fingers as rows of the 21 landmarks.
_LINES = [[0, *range(first, first + 4)] for first in (1, 5, 9, 13, 17)]


@dataclass(frozen=True, eq=False)
class Poses:
    """The hands of a capture as they are given, believed and true."""

    capture: Capture
    given: Mapping[str, HandParameters]
    believed: Mapping[str, HandParameters]
    true: Mapping[str, HandParameters]
    #: Seconds that believing took.
    seconds: float

    @classmethod
    def of(cls, capture: Capture) -> Poses:
        """Correct the poses of a simulated capture."""
        truth = capture.true_hands
        if truth is None:
            raise SystemExit(f"{capture.root}: knows no true hands")
        templates = {side: capture.template(side) for side in capture.info.sides}
        began = time.perf_counter()
        believed = believed_hands(templates, capture.hands, capture.cameras)
        return cls(capture, capture.hands, believed, truth, time.perf_counter() - began)

    def landmarks(self, hand: HandParameters, side: str) -> np.ndarray:
        """(F, 21, 2) px of a hand of the given shape, so that poses alone are compared."""
        rest = rest_skeleton(self.capture.template(side), self.given[side].betas)
        cameras = self.capture.cameras
        points = posed_skeleton(rest, hand.pose, hand.transl).seen_by(cameras.viewmats).landmarks
        image = np.einsum("fab,fnb->fna", cameras.Ks, points)
        return np.asarray(image[..., :2] / image[..., 2:])


def row(poses: Poses, side: str) -> tuple[str, list[float]]:
    """Name and errors of one hand."""
    given, believed, true = poses.given[side], poses.believed[side], poses.true[side]
    test = contiguous_split(poses.capture.info.id, len(poses.capture)).test
    cells = []
    for frames in (np.flatnonzero(given.valid), test):
        for hand in (given, believed):
            away = poses.landmarks(hand, side) - poses.landmarks(true, side)
            cells.append(float(rms(np.linalg.norm(away, axis=-1)[frames])))
    for hand in (given, believed):
        cells.append(float(rms(pose_error(hand, true)[test, 1:])))
    return f"{poses.capture.info.id}, {side}", [*cells, poses.seconds / len(poses.given)]


def table(found: Sequence[Poses]) -> Table:
    """Root mean square errors of every hand."""
    ways = ("given", "believed")
    pixels = [f"{frames}, {way} [px]" for frames in ("all", "test") for way in ways]
    columns = [Column("capture"), *(Column(name, digits=2) for name in pixels)]
    columns += [Column(f"test, {way} [rad]", digits=3) for way in ways]
    columns += [Column("seconds", digits=2)]
    rows = [row(poses, side) for poses in found for side in poses.given]
    rows.append(("mean", np.mean([numbers for _, numbers in rows], axis=0).tolist()))
    lines: list[tuple[Cell, ...]] = [(name, *numbers) for name, numbers in rows]
    return Table("Errors of poses", tuple(columns), tuple(lines))


def drawn(poses: Poses) -> list[np.ndarray]:
    """Clean frames to predict, with the three hands as lines."""
    tests = contiguous_split(poses.capture.info.id, len(poses.capture)).test
    picks = tests[np.linspace(0, len(tests) - 1, _COLUMNS).round().astype(int)]
    tiles = []
    for frame in picks.tolist():
        image = poses.capture.clean(frame) // 2 + 60
        scale = _EDGE / max(image.shape[:2])
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for name, color in COLORS.items():
            for side, hand in getattr(poses, name).items():
                points = (scale * poses.landmarks(hand, side)[frame] * 16).round().astype(int)
                lines = [points[line].reshape(-1, 1, 2) for line in _LINES]
                cv2.polylines(image, lines, False, color, 1, cv2.LINE_AA, 4)
        tiles.append(labelled(image, f"{poses.capture.info.id}, {frame}"))
    return tiles


def main(arguments: list[str] | None = None) -> int:
    """Print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", nargs="+", help="suites, or capture folders")
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args(arguments)
    captures: list[Capture] = []
    for name in args.captures:
        folders = ensure_suite(name) if name in suite_names() else [Path(name)]
        captures += [open_capture(folder) for folder in folders]
    found = [Poses.of(capture) for capture in captures]
    print(to_markdown(table(found)))
    if args.picture is not None:
        tiles = [tile for poses in found for tile in drawn(poses)]
        write_image(args.picture, sheet(tiles, _COLUMNS))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
