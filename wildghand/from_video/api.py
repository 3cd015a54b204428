"""`wildghand.fit`: an avatar of a capture or of a video, from Python."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import UsageError, of_type, place, real_number, whole_number
from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.fitting.session import fit_capture
from wildghand.from_video import VideoFit, make_avatar
from wildghand.from_video.settings import with_quick


def is_video(source: str | os.PathLike[str]) -> bool:
    """Whether a source is a video: no folder, and something or a name that has an ending."""
    path = Path(source)
    return not path.is_dir() and (path.exists() or bool(path.suffix))


def fit(
    source: Capture | str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    quick: bool = False,
    settings: Mapping[str, Any] | None = None,
    seconds: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    all_frames: bool | None = None,
    overwrite: bool = False,
    side: str | None = None,
    landmarks: str | os.PathLike[str] | None = None,
) -> WildGHandAvatar:
    """Fit an avatar to a video or to a capture, as `wildghand fit` does.

    A fit with a folder saves its state; when it was stopped, the same call goes on where it was.
    Of a video every stage is kept that has ended.

    Args:
        source: a video, a capture, or a capture's folder.
        out: the avatar folder to make. None writes nothing for a capture; for a video it is
            `hand_avatar` next to `hand.mp4`.
        quick: an avatar in a third of the time: fewer frames of a video, Gaussians and steps.
        settings: settings that override the defaults, such as `{"gaussians": 5000}`; the fields
            of `WildGHandSettings`, dotted for those of a component.
        seconds: limit of the fit, s.
        steps: limit of the fit in optimizer steps.
        seed: seed of everything random.
        all_frames: fit the validation and test frames too: for an avatar, not for a score. None:
            those of a video, not those of a capture.
        overwrite: replace an avatar that is there.
        side: of a video: `right`, `left`, `both` or `auto` (the default: one or both, as it shows).
        landmarks: of a video: its landmarks; None tracks them.

    Returns:
        The avatar; `avatar.folder` is where it lies, and `wildghand.load_avatar` opens it again.

    Raises:
        UsageError: `out` exists, a capture is too short for a split, or an argument is for videos
            only, of another type or out of range.
        BadMethod: a setting is unknown or out of range.
        BadInput: the capture or the video is wrong, or no training frame can be used.
        MissingDependency: the tracker of hands is not installed.
        DidNotConverge: the fit diverged at once.
        HwpError: the video shows no hand, another fit is writing to `out`, or `out` cannot be
            written.
    """
    if not isinstance(source, Capture):
        source = place(source, "source")
    out = None if out is None else place(out, "out")
    landmarks = None if landmarks is None else place(landmarks, "landmarks")
    of_type(settings, (Mapping, type(None)), "settings", "a table of settings by name")
    of_type(side, (str, type(None)), "side", "a text")
    seconds = None if seconds is None else real_number(seconds, "seconds")
    steps = None if steps is None else whole_number(steps, "steps")
    seed = whole_number(seed, "seed")
    if not isinstance(source, Capture) and is_video(source):
        options = VideoFit(
            side=side or "auto",
            landmarks=landmarks,
            quick=quick,
            all_frames=all_frames is not False,
            steps=steps,
            seconds=seconds,
            seed=seed,
            settings=settings or {},
        )
        return make_avatar(source, out, options, overwrite=overwrite).avatar
    for name, value in (("side", side), ("landmarks", landmarks)):
        if value is not None:
            raise UsageError("is for videos; a capture says it itself", field=name)
    return fit_capture(
        source.root if isinstance(source, Capture) else source,
        out,
        settings=with_quick(settings or {}, quick=quick),
        budget=Budget(seconds, steps),
        seed=seed,
        all_frames=all_frames is True,
        overwrite=overwrite,
    )
