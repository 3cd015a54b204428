"""The avatar of a fit with appearances: a plain one in the look of the least uncertain frames."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

import numpy as np
import torch

from hwp_bench.methods.contract import Camera, HandPose
from wildghand.plain.avatar import PlainAvatar
from wildghand.plain.model import PlainModel
from wildghand.splat.threads import denormals_flushed


class WildAvatar:
    """See `hwp_bench.methods.contract.Avatar`.

    Args:
        bake: makes the plain model that is drawn; called when the first image is asked for, since
            a fit offers an avatar after each step and few of them are drawn.
        steps: optimizer steps behind it.
        device: where it is drawn.
    """

    def __init__(self, bake: Callable[[], PlainModel], steps: int, device: str) -> None:
        self._bake = bake
        self.steps = steps
        self.device = device

    @functools.cached_property
    def plain(self) -> PlainAvatar:
        """The plain avatar with the colours that test frames have."""
        with denormals_flushed(), torch.no_grad():
            return PlainAvatar(self._bake(), self.steps)

    def render(self, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
        """Draw the hands that are given; see `PlainAvatar.render`."""
        return self.plain.render(hands, camera)
