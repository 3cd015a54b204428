"""What a method written in Python must offer, and what it is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from hwp_bench.methods.request import TrainingCapture


@dataclass(frozen=True, eq=False)
class Camera:
    """One pinhole camera, OpenCV axes."""

    #: (3, 3) intrinsics, px; pixel centres lie at +0.5.
    K: np.ndarray
    #: (4, 4) world to camera, m.
    viewmat: np.ndarray
    #: Image width, px.
    width: int
    #: Image height, px.
    height: int


@dataclass(frozen=True, eq=False)
class HandPose:
    """The parameters of one hand in one frame."""

    #: `right` or `left`.
    side: str
    #: (16, 3) axis-angle, rad.
    pose: np.ndarray
    #: (10,) shape.
    betas: np.ndarray
    #: (3,) m.
    transl: np.ndarray


@dataclass(frozen=True)
class Budget:
    """How much fitting is allowed; a method stops at whichever limit it meets first."""

    #: Seconds on the method's clock, which stands still while checkpoints are scored.
    seconds: float | None = None
    #: Optimiser steps; None leaves the method's preset.
    steps: int | None = None


class Avatar(Protocol):
    """A fitted hand (or pair of hands) that can be drawn in any pose from any camera."""

    def render(self, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
        """Draw the hands.

        Args:
            hands: by side, at least one.
            camera: the camera.

        Returns:
            (H, W, 4) float in [0, 1]: sRGB colour over black (premultiplied) and coverage.
        """
        ...


class Report(Protocol):
    """What a method calls now and then while it fits."""

    def __call__(self, step: int, avatar: Avatar) -> None:
        """Offer the state after `step` steps; it is scored when a checkpoint is due.

        Cheap when none is due, so that a method offers its state after every step; the method's
        clock stands still while a checkpoint is taken. What is offered first always is one: a
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


class Method(Protocol):
    """A way to make an avatar from a training capture.

    The entry of `method.toml` names a callable that takes `settings` (the preset's table, with
    what the command line overrides) and `seed`, and returns an object with this method.
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
    """What `entry.python` of `method.toml` names."""

    def __call__(self, settings: Mapping[str, Any], seed: int) -> Method:
        """Make the method with its settings."""
        ...
