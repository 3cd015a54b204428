"""Pictures of posed hands: exact ones, and drafts that come sooner."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.methods.contract import Camera
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.avatar.inline import over
from wildghand.splat import rasterize
from wildghand.splat.threads import denormals_flushed
from wildghand.viewer.posing import Hands


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture and what it cost."""

    #: (H, W, 3) uint8 sRGB.
    image: np.ndarray
    #: Whether it is a draft.
    draft: bool
    #: Seconds that went into its pixels.
    pixels: float
    #: Seconds that went into everything else.
    other: float

    @property
    def edge(self) -> int:
        """Its larger side, px."""
        return max(self.image.shape[:2])


class Painter:
    """Draws an avatar with the rasterizer that fits and scores it.

    A draft leaves out what depends on the camera (the light of normals that no frame has shown),
    and keeps the Gaussians for as long as the hands stay: turning the camera costs pixels only.

    Args:
        avatar: what is drawn; one thread at a time may use it.
    """

    def __init__(self, avatar: WildGHandAvatar) -> None:
        self._avatar = avatar
        self._posed: tuple[Hands, PosedGaussians] | None = None

    def full(self, hands: Hands, camera: Camera, background: tuple[int, int, int]) -> Picture:
        """Draw as `wildghand render` does.

        Args:
            hands: by side.
            camera: the camera.
            background: sRGB, 0 to 255.
        """
        began = time.perf_counter()
        image = over(self._avatar.render(hands, camera), background)
        return Picture(image, False, time.perf_counter() - began, 0.0)

    @denormals_flushed()
    @torch.no_grad()
    def draft(self, hands: Hands, camera: Camera, background: tuple[int, int, int]) -> Picture:
        """Draw sooner; see `full`.

        Args:
            hands: by side; the same object again costs no posing.
            camera: the camera.
            background: sRGB, 0 to 255.
        """
        began = time.perf_counter()
        if self._posed is None or self._posed[0] is not hands:
            self._posed = hands, self._avatar.pose(hands, closed=True)
        posed, entered = self._posed[1], time.perf_counter()
        device = torch.device(self._avatar.device)

        def tensor(array: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(array, dtype=torch.float32, device=device)

        colors, coverage, _ = rasterize(
            tensor(posed.means),
            tensor(posed.quats),
            tensor(posed.scales),
            tensor(posed.opacities),
            tensor(posed.colors),
            tensor(camera.viewmat)[None],
            tensor(camera.K)[None],
            camera.width,
            camera.height,
        )
        rgba = torch.cat((colors, coverage), dim=-1)[0].clamp(0.0, 1.0).nan_to_num(0.0)
        image = over(rgba.cpu().numpy(), background)
        return Picture(image, True, time.perf_counter() - entered, entered - began)
