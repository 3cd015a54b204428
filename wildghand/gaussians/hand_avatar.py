"""The base of every avatar on anchored Gaussians: checks, tensors, the image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import torch

from hwp_bench.base.errors import UsageError
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.splat.threads import denormals_flushed

#: Pose (1, 16, 3) rad, betas (10,) and translation (1, 3) m of the hands to draw, by side.
PosedHands = Mapping[str, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]


class HandAvatar:
    """An avatar of a subclass that says how it is drawn; see `hwp_bench.methods.contract.Avatar`.

    Args:
        sides: the hands that were fitted.
        device: where it is drawn.
        steps: optimizer steps behind it.
    """

    def __init__(self, sides: Iterable[str], device: torch.device, steps: int) -> None:
        #: The hands that it has.
        self.sides = tuple(sides)
        #: Optimizer steps behind it.
        self.steps = steps
        self._device = device

    @property
    def device(self) -> str:
        """Where it is drawn."""
        return str(self._device)

    def draw(
        self,
        hands: PosedHands,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        width: int,
        height: int,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw the hands that are given, in the order in which they were fitted.

        One camera: (1, 4, 4) and (1, 3, 3) px. Gives (1, H, W, 3) sRGB over black and (1, H, W, 1)
        coverage.
        """
        raise NotImplementedError

    @denormals_flushed()
    @torch.no_grad()
    def render(self, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
        """Draw the hands that are given.

        Returns:
            (H, W, 4) float32 in [0, 1]: sRGB colour over black (premultiplied) and coverage.

        Raises:
            UsageError: no hand, or one that was not fitted.
        """
        image, coverage = self.draw(
            self.posed(hands),
            self._tensor(camera.viewmat)[None],
            self._tensor(camera.K)[None],
            camera.width,
            camera.height,
        )
        rgba = torch.cat((image, coverage), dim=-1)[0]
        return rgba.clamp(0.0, 1.0).nan_to_num(0.0).cpu().numpy()

    def posed(self, hands: Mapping[str, HandPose]) -> PosedHands:
        """The hands that are given as tensors, in the order in which they were fitted."""
        if set(hands) - set(self.sides) or not hands:
            raise UsageError(
                f"asked for {sorted(hands)} of an avatar of {sorted(self.sides)}", field="hands"
            )
        return {
            side: (
                self._tensor(hands[side].pose)[None],
                self._tensor(hands[side].betas),
                self._tensor(hands[side].transl)[None],
            )
            for side in self.sides
            if side in hands
        }

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array), dtype=torch.float32, device=self._device)


class DrawnAvatar(HandAvatar):
    """An avatar that a function draws; see `HandAvatar`.

    Args:
        draw: as `HandAvatar.draw`; while a fit runs it may draw the live model.
    """

    def __init__(
        self,
        draw: Callable[
            [PosedHands, torch.Tensor, torch.Tensor, int, int], tuple[torch.Tensor, torch.Tensor]
        ],
        sides: Iterable[str],
        device: torch.device,
        steps: int,
    ) -> None:
        super().__init__(sides, device, steps)
        self.draw = draw  # type: ignore[method-assign, assignment]
