"""Fit an avatar from Python: the function that `wildghand.fit` is."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.fitting.session import fit_capture


def fit(
    capture: Capture | str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    seconds: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    all_frames: bool = False,
    overwrite: bool = False,
) -> WildGHandAvatar:
    """Fit an avatar to a capture, as `wildghand fit` does.

    A fit with a folder saves its state next to it; when it was stopped, the same call goes on
    where it was.

    Args:
        capture: the capture, or its folder.
        out: the avatar folder to make; None writes nothing.
        settings: settings that override the defaults, such as `{"gaussians": 5000}`; the fields
            of `WildGHandSettings`, dotted for those of a component.
        seconds: limit of the fit, s.
        steps: limit of the fit in optimizer steps.
        seed: seed of everything random.
        all_frames: fit the validation and test frames too: for an avatar, not for a score.
        overwrite: replace an avatar that is there.

    Returns:
        The avatar; where `out` holds it, `wildghand.load_avatar` opens it again.

    Raises:
        UsageError: `out` exists, or the capture is too short for a split.
        BadMethod: a setting is unknown or out of range.
        BadInput: the capture is wrong, or no training frame can be used.
        DidNotConverge: the fit diverged at once.
        HwpError: another fit is writing to `out`, or `out` cannot be written.
    """
    return fit_capture(
        capture.root if isinstance(capture, Capture) else capture,
        out,
        settings=settings,
        budget=Budget(seconds, steps),
        seed=seed,
        all_frames=all_frames,
        overwrite=overwrite,
    )
