"""A job: one video on its way to an avatar, the choices of a person, and where everything lies.

my_hand/                    an avatar folder: avatar.json, model.safetensors, weights/
my_hand/turntable.mp4       the avatar turned around
my_hand/sheet.jpg           frames, the avatar in their poses, its weights, and all sides
my_hand/avatar.html         a page that turns and poses the avatar
my_hand/work                can be deleted once the avatar pleases; a second run then begins again
    landmarks.npz           the tracked hands
    capture/                the imported capture
    avatar/, avatar.fit/    the finished fit; the state of one that goes on
    stages.json             what is done, with which video and settings
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hwp_bench.base.errors import BadCapture, UsageError
from hwp_bench.base.records import merged
from hwp_bench.capture.schema import check_id
from hwp_bench.importers.video import FitSettings
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.fitting.session import Watch
from wildghand.model.settings import nested

#: The hands that can be asked for; `auto` is one or both, as the video shows.
SIDES = ("auto", "right", "left", "both")
#: Most frames that are imported, spread over the video, by default and with `quick`: 20 s at 30
#: frames a second, and a third of that.
FRAMES, QUICK_FRAMES = 600, 200
#: What `quick` changes of the method's settings: fewer Gaussians, fewer steps.
QUICK: Mapping[str, Any] = MappingProxyType({"gaussians": 5000, "schedule": {"steps": 700}})


@dataclass(frozen=True)
class VideoFit:
    """Choices of a fit to a video.

    Raises:
        UsageError: a choice makes no sense; it names the option.
    """

    #: Which hands: one of `SIDES`, as the person sees it.
    side: str = "auto"
    #: The hand model, as `load_template` takes it.
    hand_model: str = "anny"
    #: Landmarks of the video, or None to track them.
    landmarks: Path | None = None
    #: The tracker's networks (`hwp_bench.tracking.networks.load_models`), or None for the cache.
    tracker: Path | None = None
    #: An avatar in a third of the time: fewer frames, Gaussians and steps.
    quick: bool = False
    #: Fit every frame. False leaves the last fifth out, for a score.
    all_frames: bool = True
    #: Numbers of the import's fit.
    importer: FitSettings = field(default_factory=FitSettings)
    #: Optimizer steps, or None for the settings' number.
    steps: int | None = None
    #: Most seconds of optimizing, or None.
    seconds: float | None = None
    #: Of everything random.
    seed: int = 0
    #: Settings of the method, as `wildghand.model.settings.read_settings` takes them; they win
    #: over those of `quick`.
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rules = (
            ("--side", self.side in SIDES, f"must be one of {', '.join(SIDES)}"),
            ("--steps", self.steps is None or self.steps >= 1, "must be 1 or more"),
            ("--seconds", self.seconds is None or self.seconds > 0.0, "must be more than 0"),
            ("--seed", self.seed >= 0, "must be 0 or more"),
        )
        for option, good, problem in rules:
            if not good:
                raise UsageError(problem, field=option)

    @property
    def most_frames(self) -> int:
        """Most frames that are imported."""
        return QUICK_FRAMES if self.quick else FRAMES

    def method_settings(self) -> dict[str, Any]:
        """Return the method's settings, with what `quick` changes."""
        return with_quick(self.settings, quick=self.quick)


def with_quick(settings: Mapping[str, Any], *, quick: bool) -> dict[str, Any]:
    """Return settings of the method; if `quick`, with `QUICK` in place of what they leave out."""
    return merged(QUICK, nested(settings)) if quick else dict(settings)


class Job:
    """One video, the folder of its avatar, the choices, and where everything lies.

    `world` are the processes that fit together; `watch` is who is shown the fit while it runs.
    """

    def __init__(
        self,
        video: Path,
        folder: Path,
        options: VideoFit,
        world: World = SINGLE_PROCESS,
        watch: Watch | None = None,
    ) -> None:
        self.video, self.folder, self.options = video, folder, options
        self.world, self.watch = world, watch
        self.work = folder / "work"
        self.record = self.work / "stages.json"
        self.landmarks = options.landmarks or self.work / "landmarks.npz"
        self.capture = self.work / "capture"
        self.fitted = self.work / "avatar"
        self.turntable = folder / "turntable.mp4"
        self.sheet = folder / "sheet.jpg"
        self.page = folder / "avatar.html"

    @property
    def capture_id(self) -> str:
        """Id of the capture: the folder's name where it can be one."""
        try:
            check_id(self.folder.name, str(self.folder))
        except BadCapture:
            return "hand"
        return self.folder.name
