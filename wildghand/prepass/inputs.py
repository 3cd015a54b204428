"""The input of the pre-pass: frames with their masks, hands and cameras."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.capture import Cameras, Capture
from hwp_bench.hands import HandParameters, HandTemplate, load_template


@dataclass(frozen=True, eq=False)
class PrepassInput:
    """R frames and the estimates that come with them: all that the pre-pass reads."""

    #: (R,) ascending numbers of the frames in `hands` and `cameras`.
    indices: np.ndarray
    #: (R, H, W, 3) uint8 sRGB.
    images: np.ndarray
    #: (R, H, W) uint8, 255 = visible hand.
    masks: np.ndarray
    #: Estimated parameters of every frame, by side.
    hands: Mapping[str, HandParameters]
    #: Cameras of every frame.
    cameras: Cameras
    #: Template of every side.
    templates: Mapping[str, HandTemplate]

    def __post_init__(self) -> None:
        shape = (len(self.indices), *self.images.shape[1:3])
        if self.images.shape != (*shape, 3) or self.masks.shape != shape:
            raise ShapeMismatch(
                f"images {self.images.shape} and masks {self.masks.shape} do not belong to "
                f"{len(self.indices)} frames"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return (self.images.shape[1], self.images.shape[2])

    def shrunk(self, factor: int) -> PrepassInput:
        """The same at `1 / factor` of the resolution, sizes rounded down."""
        height, width = (edge // factor for edge in self.size)
        scale = np.array([[width / self.size[1]], [height / self.size[0]], [1.0]])

        def small(images: np.ndarray) -> np.ndarray:
            return np.stack(
                [cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA) for p in images]
            )

        return replace(
            self,
            images=small(self.images),
            masks=small(self.masks),
            cameras=Cameras(self.cameras.Ks * scale, self.cameras.viewmats),
        )


def capture_input(
    capture: Capture, indices: np.ndarray, frames: Iterable[int] | None = None
) -> PrepassInput:
    """Read frames of a capture; its truth is not read.

    Args:
        capture: the capture.
        indices: (R,) ascending, which frames.
        frames: the same numbers as an iterable that shows progress.

    Raises:
        BadImage: an image is missing or damaged.
    """
    numbers = indices.tolist() if frames is None else frames
    images, masks = zip(*((capture.frame(k), capture.mask(k)) for k in numbers), strict=True)
    source = capture.info.hand_model.source
    return PrepassInput(
        indices=indices,
        images=np.stack(images),
        masks=np.stack(masks),
        hands=capture.hands,
        cameras=capture.cameras,
        templates={side: load_template(source, side) for side in capture.info.sides},
    )
