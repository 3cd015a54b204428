"""How far the hand that WildGHand bends to a person is from the person's own.

Run from the repository: `python -m benchmarks.person CAPTURE...` bends the hand model to the masks
of each simulated capture's training frames, as a fit does before its first step, and compares it at
rest with the hand that was rendered: without bending, with it, with control points and joints
alone, and with training frames that choose how far it bends. `--picture FILE` draws the distances.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import torch

from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.images import write_image
from hwp_bench.base.tables import Column, Table, to_markdown
from hwp_bench.capture import open_capture
from hwp_bench.capture.schema import TRUE_TEMPLATE, read_subject_mesh
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands import HandTemplate
from hwp_bench.hands.raster import draw_faces, mix_corners
from hwp_bench.methods.contract import Budget, RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request
from hwp_bench.sim.produce.truth import add_subject_mesh
from wildghand.fitting.data import FitData
from wildghand.fitting.start import find_person
from wildghand.subject import SubjectShape, unknowns
from wildghand.subject.shape import side_flip

#: How large proportions are expected to be, and whether validation frames may choose, by what is
#: compared.
WAYS: Mapping[str, tuple[dict[str, float], bool]] = {
    "bent": ({}, True),
    "no proportions": ({"LENGTH_SPREAD": 1e-6, "THICKNESS_SPREAD": 1e-6}, True),
    "training frames choose": ({}, False),
}
# Edge of a drawn hand, px, and the distance that is drawn as the hottest colour, m.
_SIZE, _HOT = 260, 8e-3


@dataclass(frozen=True, eq=False)
class Person:
    """A capture of a person whose rest hand is known."""

    name: str
    training: TrainingCapture
    #: The rest hand of the model, of either side.
    template: HandTemplate
    #: What the model's right hand lacks of the person's.
    truth: SubjectShape

    def shape(self, spreads: Mapping[str, Any], validation: bool) -> tuple[SubjectShape, float]:
        """The shape that a fit finds, and its seconds."""
        data = FitData(self.training, torch.device("cpu"))
        judges = data.judges if validation else None
        _ = data.frames  # read before the clock starts
        began = time.perf_counter()
        with contextlib.ExitStack() as stack:
            for name, value in spreads.items():
                stack.enter_context(mock.patch.object(unknowns, name, value))
            shape = find_person(data, judges)
        assert shape is not None
        return shape, time.perf_counter() - began

    def distances(self, shape: SubjectShape) -> tuple[np.ndarray, np.ndarray]:
        """(V,) and (16,) m from the person's surface and joints."""
        surface, joints = shape.vertices - self.truth.vertices, shape.joints - self.truth.joints
        return np.linalg.norm(surface, axis=1), np.linalg.norm(joints, axis=1)


def open_person(folder: Path, work: Path) -> Person:
    """Read a simulated capture.

    Args:
        folder: the capture.
        work: an empty folder.

    Raises:
        SystemExit: its person is another mesh than the hand model's.
    """
    capture = open_capture(folder)
    if not add_subject_mesh(capture):
        raise SystemExit(f"{folder}: the person's rest hand is not known")
    split = contiguous_split(capture.info.id, len(capture))
    write_request(work, capture, split, RunSettings({}, 0, Budget(steps=1)))
    training = open_request(work)
    surfaces, joints = [], []
    for side in training.sides:
        template, betas = training.template(side), training.hands[side].betas
        own, flip = read_subject_mesh(capture.root / TRUE_TEMPLATE, template), side_flip(side)
        surfaces.append((own.vertices - template.vertices - template.shape_basis @ betas) * flip)
        joints.append((own.joints - template.joints - template.joint_basis @ betas) * flip)
    mean = np.mean(joints, axis=0)
    truth = SubjectShape(np.mean(surfaces, axis=0) - mean[0], mean - mean[0])
    template = training.template(training.sides[0])
    return Person(capture.info.id, training, template, truth)


def drawn(person: Person, shape: SubjectShape) -> np.ndarray:
    """Palm and back of the rest hand, coloured by the distance from the person's: (H, W, 3)."""
    hand = shape.applied(person.template)
    distance = person.distances(shape)[0][:, None]
    low, high = hand.vertices.min(axis=0), hand.vertices.max(axis=0)
    scale = 0.92 * _SIZE / (high - low).max()
    views = []
    for up in (-1.0, 1.0):
        places = (hand.vertices - 0.5 * (low + high)) * scale
        pixels = np.column_stack([up * places[:, 2], places[:, 0]]) + 0.5 * _SIZE
        face, mix = draw_faces(pixels, 1.0 - up * hand.vertices[:, 1], hand.faces, (_SIZE, _SIZE))
        inside = face >= 0
        heat = np.zeros((_SIZE, _SIZE), np.uint8)
        values = mix_corners(distance, hand.faces, face[inside], mix[inside])[:, 0]
        heat[inside] = np.clip(255.0 * values / _HOT, 0.0, 255.0).astype(np.uint8)
        picture = cv2.cvtColor(cv2.applyColorMap(heat, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
        picture[~inside] = 250
        views.append(picture)
    return np.concatenate(views, axis=1)


def compared(person: Person) -> dict[str, tuple[SubjectShape, float]]:
    """The hand model and the shapes of all ways, with their seconds."""
    truth = person.truth
    none = SubjectShape(np.zeros_like(truth.vertices), np.zeros_like(truth.joints))
    return {"hand model": (none, 0.0)} | {name: person.shape(*way) for name, way in WAYS.items()}


def table(rows: Sequence[tuple[str, np.ndarray, float]]) -> Table:
    """One row for each capture, and their mean.

    Args:
        rows: names, (ways, 2) distances of surface and joints in mm, and the seconds of `bent`.
    """
    columns = [Column("capture")]
    for group in ("hand model", *WAYS):
        columns += [Column(f"{part}, mm", group=group) for part in ("surface", "joints")]
    columns.append(Column("s", digits=1, group="bent"))
    every = list(rows)
    distances = np.mean([row[1] for row in rows], axis=0)
    every.append(("mean", distances, sum(row[2] for row in rows) / len(rows)))
    cells = tuple((name, *numbers.ravel().tolist(), seconds) for name, numbers, seconds in every)
    return Table("Mean distance from the person at rest", tuple(columns), cells, ranked=False)


def main() -> None:
    """Print the table, and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("captures", nargs="+", type=Path, help="folders of simulated captures")
    parser.add_argument("--picture", type=Path, help="where to draw the distances")
    args = parser.parse_args()
    rows, tiles = [], []
    for folder in args.captures:
        with tempfile.TemporaryDirectory() as work:
            person = open_person(folder, Path(work) / "request")
            found = compared(person)
        numbers = [
            [1e3 * part.mean() for part in person.distances(shape)] for shape, _ in found.values()
        ]
        rows.append((person.name, np.array(numbers), found["bent"][1]))
        for name in ("hand model", "bent"):
            shape = found[name][0]
            caption = f"{person.name}, {name}: {1e3 * person.distances(shape)[0].mean():.1f} mm"
            tiles.append(labelled(drawn(person, shape), caption))
    print(to_markdown(table(rows)))
    if args.picture:
        write_image(args.picture, sheet(tiles, 4))


if __name__ == "__main__":
    main()
