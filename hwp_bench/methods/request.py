"""The folder that a method is given: everything it may see of a capture, and nothing more.

A request holds the training and validation frames with their masks, and for every frame,
test frames included, the estimated hand parameters and the cameras. It holds no test pixel, no
truth and no word about the perturbations. Of the free-view clip it holds parameters and cameras.

The frames are those that were captured, or an oracle's choice of them
(`hwp_bench/methods/material.py`).
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import atomic_folder, read_json, write_json
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.base.records import parse_record, without_schema
from hwp_bench.capture.schema import (
    CAMERAS,
    FREE_VIEW,
    HANDS,
    image_path,
    write_cameras,
    write_hands,
    write_subject_mesh,
)
from hwp_bench.capture.splits import Split
from hwp_bench.methods.contract import (
    REQUEST,
    TEMPLATE,
    RequestRecord,
    RunSettings,
    TrainingCapture,
)
from hwp_bench.methods.material import free_view_hands, gives_mesh, training_material

if TYPE_CHECKING:
    from hwp_bench.capture import Capture

#: Version of the request folder.
SCHEMA = "hwp-request/1"


def write_request(path: Path, capture: Capture, split: Split, run: RunSettings) -> Path:
    """Write the part of a capture that a method may see into a folder of its own.

    Images are copied, not linked: a link would lead to the capture, and so to its test frames.

    Raises:
        BadImage: a training or validation image is missing or damaged.
        UsageError: the capture does not know what `run.frames` asks for.
    """
    info = capture.info
    material = training_material(capture, split, run.frames)
    with atomic_folder(path, overwrite=True) as root:
        for frame in [*material.train.tolist(), *split.validation.tolist()]:
            for kind, source_kind, read in (
                ("frames", material.frames, read_rgb),
                ("masks", material.masks, read_gray),
            ):
                source = image_path(capture.root, source_kind, frame)
                # Reading first names a damaged image here, before a method stumbles over it.
                read(source, capture.size)
                target = image_path(root, kind, frame)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)
        write_hands(root / HANDS, material.hands)
        write_cameras(root / CAMERAS, capture.cameras)
        mesh = gives_mesh(run.frames)
        if mesh:
            own = {side: capture.true_template(side) for side in info.sides}
            write_subject_mesh(root / TEMPLATE, own)
        clip = capture.free_view
        if clip is not None:
            (root / FREE_VIEW).mkdir()
            write_hands(root / FREE_VIEW / HANDS, free_view_hands(clip, run.frames))
            write_cameras(root / FREE_VIEW / CAMERAS, clip.cameras)
        description = {
            "schema": SCHEMA,
            "id": info.id,
            "hands": info.hands,
            "width": info.width,
            "height": info.height,
            "fps": info.fps,
            "hand_model": info.to_json()["hand_model"],
            "split": split.to_json(),
            "settings": dict(run.settings),
            "seed": run.seed,
            "budget": {"seconds": run.budget.seconds, "steps": run.budget.steps},
            "frames": run.frames,
            "train": material.train.tolist(),
            **({"free_view": len(clip)} if clip is not None else {}),
            **({"own_template": True} if mesh else {}),
        }
        write_json(root / REQUEST, description)
    return path


def open_request(path: str | os.PathLike[str]) -> TrainingCapture:
    """Open a request folder.

    Raises:
        BadInput: it is not a request of this version, or damaged.
    """
    root = Path(path)
    where = root / REQUEST
    value = without_schema(read_json(where), SCHEMA, where=where, error=BadInput)
    return TrainingCapture(root, parse_record(RequestRecord, value, where=where, error=BadInput))
