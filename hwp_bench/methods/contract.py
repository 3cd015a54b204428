"""The contract of a method written in Python: the classes that it offers and those it is given."""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import numpy as np
from msgspec import Meta

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import BadInput, UsageError, of_type, real_number, whole_number
from hwp_bench.base.images import read_gray, read_rgb
from hwp_bench.base.records import MAX_COUNT, MAX_SECONDS, Line, Seed, brief, whole_seed
from hwp_bench.capture.schema import (
    CAMERAS,
    FREE_VIEW,
    HANDS,
    MAX_FRAMES,
    SIDES,
    Cameras,
    FrameRate,
    HandModelId,
    image_path,
    read_cameras,
    read_hands,
)
from hwp_bench.capture.splits import Split
from hwp_bench.hands.skeleton import Camera, HandParameters, HandPose, hand_poses

if TYPE_CHECKING:
    from hwp_bench.hands.skinning import PosedHand
    from hwp_bench.hands.template import HandTemplate

#: Name of the file that describes a request folder.
REQUEST = "request.json"
#: The subject's own hands at rest, in the request of an error budget that replaces the template.
TEMPLATE = "template.npz"
#: Training frames as they were captured; their clean versions; only those without perturbation.
FRAME_CHOICES = ("perturbed", "clean", "unperturbed-only")

_Pixels = Annotated[int, Meta(ge=1, le=65_536)]


class Method(Protocol):
    """A way to make an avatar from a training capture.

    The entry of `method.toml` names a callable that takes `settings` (the preset's table, with
    the overrides of the command line; `light.degree` is in the table `light`) and `seed`, and
    returns an object with this method.
    """

    def fit(self, training: TrainingCapture, budget: Budget, report: Report) -> Avatar:
        """Fit an avatar.

        Args:
            training: training and validation frames with masks, and the hand parameters and
                cameras of every frame.
            budget: when to stop.
            report: where to offer checkpoints.

        Returns:
            The avatar that the test frames are rendered with.
        """
        ...


class MethodFactory(Protocol):
    """The callable that `entry.python` of `method.toml` names."""

    def __call__(self, settings: Mapping[str, Any], seed: int) -> Method:
        """Make the method with its settings."""
        ...


class Avatar(Protocol):
    """A fitted hand (or pair of hands) that can be drawn in any pose from any camera.

    It may have attributes: `steps`, the step of the state that is returned (without it, the last
    step that was reported; a result counts all that were taken), and `device`, such as `cuda`
    (without it, `cuda` where torch has used it, else `cpu`).
    """

    def render(self, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
        """Draw the hands.

        Args:
            hands: by side, at least one.
            camera: the camera.

        Returns:
            (H, W, 3) float in [0, 1]: sRGB colour over black; or (H, W, 4), with the coverage as
            a fourth channel, which no score looks at.
        """
        ...


class Report(Protocol):
    """The object that a method calls now and then while it fits."""

    def __call__(self, step: int, avatar: Avatar) -> None:
        """Offer the state after `step` steps; it is scored when a checkpoint is due.

        Cheap when none is due, so that a method offers its state after every step; the method's
        clock stands still while a checkpoint is taken. The first offer is always a checkpoint: a
        method offers the avatar before its first step, with `step` 0.
        """
        ...

    def progress(self, done: int, total: int) -> None:
        """Say how far the fit is, in steps."""
        ...

    @property
    def elapsed(self) -> float:
        """Seconds on the method's clock since `fit` was called."""
        ...


@dataclass(frozen=True)
class Budget:
    """How much fitting is allowed; a method stops at the limit that it reaches first."""

    #: Seconds on the method's clock, which stands still while checkpoints are scored.
    seconds: float | None = None
    #: Optimizer steps; None keeps the method's preset.
    steps: int | None = None

    def __post_init__(self) -> None:
        for name, most in (("seconds", MAX_SECONDS), ("steps", MAX_COUNT)):
            value = getattr(self, name)
            if value is None:
                continue
            checked = (whole_number if name == "steps" else real_number)(value, name)
            object.__setattr__(self, name, checked)
            if not 0 <= value <= most:
                raise UsageError(f"{brief(value)} is not from 0 to {most:g}", field=name)


@dataclass(frozen=True)
class RunSettings:
    """How a method is run on one capture."""

    #: Settings of the method: the preset's table with overrides.
    settings: Mapping[str, Any] = field(default_factory=dict)
    #: Seed of all random numbers.
    seed: int = 0
    #: When to stop fitting.
    budget: Budget = field(default_factory=Budget)
    #: Which training frames are given, one of `FRAME_CHOICES`; all but the first are oracles.
    frames: str = FRAME_CHOICES[0]

    def __post_init__(self) -> None:
        of_type(self.settings, Mapping, "settings", "a table of settings by name")
        of_type(self.frames, str, "frames", "a text")
        object.__setattr__(self, "seed", whole_seed(self.seed, "seed"))


@dataclass(frozen=True)
class FreeViews:
    """The frames of the free-view clip: unseen poses from cameras all around, to be rendered."""

    #: Parameters of every frame, by side: true angles, with the betas of the capture.
    hands: Mapping[str, HandParameters]
    cameras: Cameras

    def __len__(self) -> int:
        return len(self.cameras)

    def hand_poses(self, frame: int) -> dict[str, HandPose]:
        """Return the parameters of every hand in one frame, by side."""
        return hand_poses(self.hands, frame)


@dataclass(frozen=True)
class RequestRecord:
    """The fields of `request.json`, but for its schema."""

    #: The capture's id, hands, frame size [px], frames per second and hand model.
    id: Line
    hands: str = field(metadata={"choices": tuple(SIDES)})
    width: _Pixels
    height: _Pixels
    fps: FrameRate
    hand_model: HandModelId
    #: `Split.from_json` checks it.
    split: Any
    #: As `RunSettings` has them.
    settings: dict[str, Any]
    seed: Seed
    budget: Budget
    frames: Line
    train: list[Annotated[int, Meta(ge=0)]]
    #: Frames of the free-view clip; 0 where the capture has none.
    free_view: Annotated[int, Meta(ge=0, le=MAX_FRAMES)] = 0
    #: Whether `template.npz` holds the subject's own mesh, in place of the hand model's template.
    own_template: bool = False


class TrainingCapture:
    """The part of a capture that a method sees."""

    def __init__(self, root: Path, record: RequestRecord) -> None:
        #: The request folder, and the capture's id.
        self.root, self.id = root, record.id
        #: The hands in it, `right`, `left` or both.
        self.sides: tuple[str, ...] = SIDES[record.hands]
        #: Size of the frames, px, and frames per second.
        self.width, self.height, self.fps = record.width, record.height, record.fps
        #: The hand model that the parameters belong to.
        self.hand_model = record.hand_model
        #: Which frames train, validate, and are to be predicted.
        self.split = Split.from_json(record.split, where=os.fspath(root / REQUEST))
        count = self.split.frame_count
        #: Estimated parameters of every frame, by side, and the cameras of every frame.
        self.hands: dict[str, HandParameters] = read_hands(root / HANDS, self.sides, count)
        self.cameras: Cameras = read_cameras(root / CAMERAS, count)
        #: Settings, seed and budget.
        self.run = RunSettings(record.settings, record.seed, record.budget, record.frames)
        #: What is rendered of the free-view clip, or None where there is none.
        self.free_views: FreeViews | None = None
        if record.free_view:
            self.free_views = FreeViews(
                read_hands(root / FREE_VIEW / HANDS, self.sides, record.free_view),
                read_cameras(root / FREE_VIEW / CAMERAS, record.free_view),
            )
        self._own_template = record.own_template
        self._templates: dict[str, HandTemplate] = {}
        self._train = np.array(record.train, dtype=np.int64)
        if not np.isin(self._train, self.split.train).all():
            raise BadInput(
                "has a frame that the split does not train on", where=root / REQUEST, field="train"
            )

    @property
    def train(self) -> np.ndarray:
        """Indices of the training frames."""
        return self._train

    def thinned(self, most: int) -> TrainingCapture:
        """Return the same capture with at most `most` training frames, evenly spread."""
        if len(self._train) <= most:
            return self
        fewer = copy.copy(self)
        fewer._train = self._train[evenly(len(self._train), max(1, most))]
        return fewer

    def with_hands(self, hands: Mapping[str, HandParameters]) -> TrainingCapture:
        """Return the same capture with other hand parameters of every frame, by side."""
        other = copy.copy(self)
        other.hands = dict(hands)
        return other

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
        return hand_poses(self.hands, frame)

    def camera(self, frame: int) -> Camera:
        """Return the camera of one frame."""
        return self.cameras.camera(frame, self.width, self.height)

    def vertices(self, frame: int | Mapping[str, HandPose]) -> dict[str, np.ndarray]:
        """Return the vertices of the posed hands, (V, 3) float64 m, by side.

        They are in the world of `camera`; `template(side).faces` connects them. `frame` is the
        index of any frame, of which every hand is returned that the frame shows
        (`hands[side].valid`); or it is poses by side, as `Avatar.render` is given them.
        """
        return {side: hand.vertices[0].numpy() for side, hand in self._posed(frame).items()}

    def joints(self, frame: int | Mapping[str, HandPose]) -> dict[str, np.ndarray]:
        """Return the joints of the posed hands, (16, 3) float64 m, by side, as `vertices` does.

        `hwp_bench.hands.skeleton.JOINT_NAMES` names the rows.
        """
        return {side: hand.joints[0].numpy() for side, hand in self._posed(frame).items()}

    def _posed(self, frame: int | Mapping[str, HandPose]) -> dict[str, PosedHand]:
        from hwp_bench.hands.skinning import pose_parameters

        if isinstance(frame, Mapping):
            hands = frame
        else:
            shown = {side for side, hand in self.hands.items() if hand.valid[frame]}
            hands = {side: hand for side, hand in self.hand_poses(frame).items() if side in shown}
        posed = {}
        for side, hand in hands.items():
            if side not in self._templates:
                self._templates[side] = self.template(side)
            arrays = (hand.pose[None], hand.betas, hand.transl[None], np.ones(1, bool))
            posed[side] = pose_parameters(self._templates[side], HandParameters(*arrays))
        return posed

    def template(self, side: str) -> HandTemplate:
        """Load the hand template of one side.

        It is that of the hand model; in an error budget with the truth `mesh` it is the subject's
        own, which no shape parameter changes. A template that is not the capture's is refused.
        """
        from hwp_bench.capture.folder import load_matching_template
        from hwp_bench.capture.schema import read_subject_mesh

        if side not in self.sides:
            raise UsageError(f"this capture has no {side} hand", where=self.root)
        model = load_matching_template(self.hand_model, self.sides, side, where=self.root)
        if not self._own_template:
            return model
        return read_subject_mesh(self.root / TEMPLATE, model)
