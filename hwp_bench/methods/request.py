"""The folder that a method is given: everything it may see of a capture, and nothing more.

A request holds the training and validation frames with their masks, and for every frame,
test frames included, the estimated hand parameters and the cameras. No test pixel, no truth and
no word about the perturbations is in it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import atomic_folder, read_json, write_json
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.capture.layout import CAMERAS, HANDS, image_path
from hwp_bench.capture.schema import SIDES, HandModelId
from hwp_bench.capture.splits import Split
from hwp_bench.capture.tracks import Cameras, read_cameras, read_hands, write_cameras, write_hands
from hwp_bench.hands.parameters import HandParameters
from hwp_bench.methods.contract import Budget, Camera, HandPose
from hwp_bench.methods.material import FRAME_CHOICES, training_material

if TYPE_CHECKING:
    from hwp_bench.capture import Capture
    from hwp_bench.hands.template import HandTemplate

#: Version of the request folder.
SCHEMA = "hwp-request/1"
#: Name of the file that describes it.
REQUEST = "request.json"


@dataclass(frozen=True)
class RunSettings:
    """How a method is run on one capture."""

    #: Settings of the method: the preset's table with overrides.
    settings: Mapping[str, Any]
    #: Seed of everything random.
    seed: int = 0
    #: When to stop fitting.
    budget: Budget = field(default_factory=Budget)
    #: Which training frames are given, one of `FRAME_CHOICES`; all but the first are oracles.
    frames: str = FRAME_CHOICES[0]


class TrainingCapture:
    """What a method sees of a capture.

    Attributes:
        root: the request folder.
        id: the capture's id.
        sides: the hands in it, `right`, `left` or both.
        width: frame width, px.
        height: frame height, px.
        fps: frames per second.
        hand_model: the hand model that the parameters belong to.
        split: which frames train, validate, and are to be predicted.
        hands: estimated parameters of every frame, by side.
        cameras: the cameras of every frame.
        run: settings, seed and budget.
    """

    def __init__(self, root: Path, value: Mapping[str, Any]) -> None:
        self.root = root
        self.id: str = value["id"]
        self.sides: tuple[str, ...] = SIDES[value["hands"]]
        self.width: int = value["width"]
        self.height: int = value["height"]
        self.fps: float = value["fps"]
        self.hand_model = HandModelId(**value["hand_model"])
        self.split = Split.from_json(value["split"], where=os.fspath(root / REQUEST))
        self.hands: dict[str, HandParameters] = read_hands(
            root / HANDS, self.sides, self.split.frame_count
        )
        self.cameras: Cameras = read_cameras(root / CAMERAS, self.split.frame_count)
        self.run = RunSettings(
            value["settings"], value["seed"], Budget(**value["budget"]), value["frames"]
        )
        self._train = np.array(value["train"], dtype=np.int64)

    @property
    def train(self) -> np.ndarray:
        """Indices of the training frames."""
        return self._train

    @property
    def validation(self) -> np.ndarray:
        """Indices of the validation frames."""
        return self.split.validation

    @property
    def targets(self) -> np.ndarray:
        """Indices of the frames to predict; their pixels are not here."""
        return self.split.test

    def frame(self, frame: int) -> np.ndarray:
        """Read a training or validation frame: (H, W, 3) uint8 sRGB."""
        return read_rgb(image_path(self.root, "frames", frame), (self.height, self.width))

    def mask(self, frame: int) -> np.ndarray:
        """Read its estimated visible-hand mask: (H, W) uint8, 255 = hand."""
        return read_gray(image_path(self.root, "masks", frame), (self.height, self.width))

    def hand_poses(self, frame: int) -> dict[str, HandPose]:
        """Return the parameters of every hand in one frame, by side."""
        return {
            side: HandPose(side, hand.pose[frame], hand.betas, hand.transl[frame])
            for side, hand in self.hands.items()
        }

    def camera(self, frame: int) -> Camera:
        """Return the camera of one frame."""
        return Camera(self.cameras.Ks[frame], self.cameras.viewmats[frame], self.width, self.height)

    def template(self, side: str) -> HandTemplate:
        """Load the hand template of one side.

        Raises:
            BadInput: the template that is installed here is another than the capture's.
        """
        from hwp_bench.capture.hand_model import load_matching_template

        if side not in self.sides:
            raise UsageError(f"this capture has no {side} hand", where=self.root)
        return load_matching_template(self.hand_model, self.sides, side, where=self.root)


def write_request(path: Path, capture: Capture, split: Split, run: RunSettings) -> Path:
    """Write what a method may see of a capture into a folder of its own.

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
        }
        write_json(root / REQUEST, description)
    return path


def open_request(path: str | os.PathLike[str]) -> TrainingCapture:
    """Open a request folder.

    Raises:
        BadInput: it is no request of this version, or damaged.
    """
    root = Path(path)
    value = read_json(root / REQUEST)
    if not isinstance(value, dict) or value.get("schema") != SCHEMA:
        raise BadInput(f"is no request of schema {SCHEMA}", where=root / REQUEST)
    try:
        return TrainingCapture(root, value)
    except (KeyError, TypeError) as error:
        raise BadInput(f"lacks or has a wrong field ({error})", where=root / REQUEST) from error
