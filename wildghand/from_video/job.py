"""A job: one video on its way to an avatar, and where everything of it lies.

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

from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import BadCapture
from hwp_bench.capture.schema import check_id
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.fitting.session import Watch
from wildghand.from_video.settings import VideoFit


@dataclass(frozen=True, eq=False)
class Job:
    """One video, the folder of its avatar, and the choices.

    Attributes:
        video: the file.
        folder: of the avatar.
        options: the choices.
        world: the processes that fit together.
        watch: who is shown the fit while it runs.
    """

    video: Path
    folder: Path
    options: VideoFit
    world: World = SINGLE_PROCESS
    watch: Watch | None = None

    @property
    def work(self) -> Path:
        """The folder of everything that leads to the avatar."""
        return self.folder / "work"

    @property
    def record(self) -> Path:
        """The record of what is done."""
        return self.work / "stages.json"

    @property
    def landmarks(self) -> Path:
        """The tracked hands."""
        return self.options.landmarks or self.work / "landmarks.npz"

    @property
    def capture(self) -> Path:
        """The imported capture."""
        return self.work / "capture"

    @property
    def fitted(self) -> Path:
        """The avatar as the fit wrote it."""
        return self.work / "avatar"

    @property
    def turntable(self) -> Path:
        """The clip of the avatar turned around."""
        return self.folder / "turntable.mp4"

    @property
    def sheet(self) -> Path:
        """The contact sheet."""
        return self.folder / "sheet.jpg"

    @property
    def page(self) -> Path:
        """The page that turns and poses the avatar."""
        return self.folder / "avatar.html"

    @property
    def capture_id(self) -> str:
        """Id of the capture: the folder's name where it can be one."""
        try:
            check_id(self.folder.name, str(self.folder))
        except BadCapture:
            return "hand"
        return self.folder.name
