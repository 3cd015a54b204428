"""Suites of real clips: their manifests, the download, and one import that is the same everywhere.

A manifest pins every clip by its SHA-256. The clip is tracked and imported on the machine that
needs it, because its pixels are not the toolkit's to pass on. Two machines may round an import
otherwise, so that the digests of its captures differ. What the capture was made from does not:
`RealClip.origin` is known without the data.
"""

from __future__ import annotations

import urllib.parse
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, ClassVar

from msgspec import Meta

from hwp_bench.base.console import notice
from hwp_bench.base.download import NotAvailable, Pinned, download
from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.files import cache_root, disc_errors, sha256_file, temporary_name
from hwp_bench.base.folders import exclusive
from hwp_bench.base.records import Digest, Line, parse_record, parse_toml, without_schema
from hwp_bench.capture import CaptureInfo, open_capture
from hwp_bench.capture.schema import MAX_EDGE, MAX_FRAMES, SIDES, check_id, import_origin

#: Version of the manifests.
SCHEMA = "hwp-clips/1"
#: Largest file of a clip, bytes.
MAX_BYTES = 200_000_000
#: Folder of the manifests, each named by its suite.
MANIFESTS = Path(__file__).parent


@dataclass(frozen=True)
class RealClip:
    """One clip of a suite, as its manifest describes it."""

    #: Id of its capture.
    id: Line
    #: Repository on GitHub, `OWNER/NAME`, a commit of it, and the file's path in it.
    repository: Annotated[str, Meta(pattern=r"\A[\w.-]{1,100}/[\w.-]{1,100}\Z")]
    commit: Annotated[str, Meta(pattern=r"\A[0-9a-f]{40}\Z", description="40 hexadecimal digits")]
    path: Line
    #: Size and SHA-256 of the file.
    bytes: Annotated[int, Meta(ge=1, le=MAX_BYTES)]
    sha256: Digest
    #: Terms of the repository.
    licence: Line
    #: What is seen.
    shows: Line
    #: `right`, `left` or `both`.
    hands: str = field(metadata={"choices": tuple(SIDES)})
    #: Every how many frames one is imported.
    stride: Annotated[int, Meta(ge=1, le=1000)]
    #: Edge of the imported frames, px.
    size: Annotated[int, Meta(ge=32, le=MAX_EDGE)]
    #: Frames that the import makes of it.
    frame_count: Annotated[int, Meta(ge=10, le=MAX_FRAMES)]
    #: Perturbations that it shows, where somebody has said so.
    perturbations: tuple[Line, ...] = ()
    #: Masks of real clips are estimates.
    exact_masks: ClassVar[bool] = False

    @property
    def file(self) -> Pinned:
        """The video."""
        parts = f"{self.repository}/{self.commit}/{self.path}"
        address = f"https://raw.githubusercontent.com/{urllib.parse.quote(parts)}"
        return Pinned(address, self.bytes, self.sha256)

    @property
    def origin(self) -> str:
        """Digest (hex) of what its capture is made from; see `CaptureInfo.origin`."""
        # Imported here: it brings torch, which a list of suites does not need.
        from hwp_bench.importers.video.api import MADE_BY

        frames = range(0, self.frame_count * self.stride, self.stride)
        return import_origin(self.sha256, MADE_BY, frames, self.size, self.hands)

    @property
    def capture(self) -> Path:
        """Folder of its capture in the cache."""
        return cache_root() / "real" / "captures" / f"{self.id}-{self.origin[:12]}"

    def is_source_of(self, info: CaptureInfo) -> bool:
        """Return whether a capture is the import of this clip."""
        return info.id == self.id and info.origin == self.origin

    def is_whole(self) -> bool:
        """Whether its capture is in the cache."""
        try:
            return self.is_source_of(open_capture(self.capture).info)
        except HwpError:
            return False

    def fetch(self, folder: Path | None = None) -> Path:
        """Return the video in the cache, from a folder or downloaded if it is not there yet.

        Args:
            folder: its files are looked at in place of the network, whatever they are called.

        Raises:
            HwpError: it is not available.
            BadInput: the download is another file.
        """
        video = cache_root() / "real" / "videos" / f"{self.id}-{self.sha256[:12]}"
        if not self._is(video):
            source = None if folder is None else self._in_folder(folder)
            temporary = temporary_name(video)
            with disc_errors(video):
                video.parent.mkdir(parents=True, exist_ok=True)
                try:
                    with temporary.open("xb") as stream:
                        if source is None:
                            download(self.file, stream)
                        else:
                            download(self.file, stream, lambda _: source.open("rb"))
                    temporary.replace(video)
                finally:
                    temporary.unlink(missing_ok=True)
        return video

    def _in_folder(self, folder: Path) -> Path:
        found = next((path for path in sorted(folder.iterdir()) if self._is(path)), None)
        if found is None:
            raise NotAvailable(f"holds no file of {self.id} (SHA-256 {self.sha256})", where=folder)
        return found

    def _is(self, path: Path) -> bool:
        same_size = path.is_file() and path.stat().st_size == self.bytes
        return same_size and sha256_file(path) == self.sha256

    def ensure(self, video: Path) -> Path:
        """Return its capture in the cache, tracked and imported from its video if need be."""
        from hwp_bench.importers.video import FrameRange, VideoImport, import_video
        from hwp_bench.tracking import track_video

        out = self.capture
        with exclusive(out, wait=True):
            if self.is_whole():
                return out
            landmarks = out.with_name(f"{out.name}.npz")
            notice(f"{self.id}: {self.shows} ({self.licence}, {self.repository})")
            track_video(video, landmarks, overwrite=True)
            options = VideoImport(
                side=self.hands,
                size=self.size,
                frames=FrameRange(stride=self.stride),
                id=self.id,
                action=self.shows,
                licence=f"{self.licence}, github.com/{self.repository}",
                perturbations=self.perturbations,
                overwrite=True,
            )
            clip = import_video(video, landmarks, out, options)
            frames = len(clip.source.indices)
            if frames != self.frame_count:
                problem = f"has {frames} frames where the manifest says {self.frame_count}"
                raise BadInput(problem, where=self.id, field="frame_count")
        return out


@dataclass(frozen=True)
class _Manifest:
    """The clips of a suite."""

    clips: Annotated[tuple[RealClip, ...], Meta(min_length=1, max_length=1000)]


@cache
def read_clips(name: str) -> tuple[RealClip, ...]:
    """Return the clips of a suite, in the manifest's order."""
    path = MANIFESTS / f"{name}.toml"
    content = parse_toml(path.read_text("utf-8"), where=path)
    value = without_schema(content, SCHEMA, where=path)
    clips = parse_record(_Manifest, value, where=path, error=BadInput).clips
    for clip in clips:
        check_id(clip.id, str(path))
    return clips


def ensure_clips(name: str, folder: Path | None = None) -> tuple[list[Path], Mapping[str, str]]:
    """Make sure of the captures of a suite of real clips.

    Args:
        name: the suite.
        folder: files that stand in for the network; see `RealClip.fetch`.

    Returns:
        The capture folders, in the suite's order, and why a clip is not among them, by its id.

    Raises:
        HwpError: no clip is available, or an import failed.
        MissingDependency: the tracker is not installed.
    """
    if folder is not None and not folder.is_dir():
        raise UsageError("is not a folder", where=folder, field="--from")
    found, missing = [], {}
    for clip in read_clips(name):
        if clip.is_whole():
            found.append(clip.capture)
            continue
        try:
            video = clip.fetch(folder)
        except (NotAvailable, BadInput) as error:
            missing[clip.id] = str(error)
            notice(f"{name} without {clip.id}: {error}")
            continue
        found.append(clip.ensure(video))
    if not found:
        raise HwpError(
            f"no clip of {name} is available",
            remedy=f"With the network run `hwp-bench data get {name}`; or give its files with "
            f"`hwp-bench data get {name} --from FOLDER`.",
        )
    return found, missing
