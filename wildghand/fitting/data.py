"""The data of a fit, and judgements of its frames before there is a model."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.anchors import HandSurfaces
from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.training import (
    FrameTable,
    TrainingClip,
    TrainingFrames,
    load_frames,
    load_judges,
    shares_of_255,
    upload,
)
from wildghand.subject import SubjectShape

#: Edge of a place of the skin, m on the rest hand: about half a segment of a finger.
PLACE = 0.01


@dataclass(frozen=True, eq=False)
class Judgement:
    """Judgements of R frames before they are fitted; without a pre-pass all are clean."""

    #: (R,) probability that a frame is clean.
    clean: Tensor
    #: (R,) up to 1; DPD's temporal weights start from them.
    frame_weights: Tensor
    #: (R,) float64, gain on the linear light of each frame, mean over channels.
    gains: Tensor
    #: (R, H, W) uint8, what is left of the pixels, 255 = all; None: all is.
    pixels: Tensor | None = None

    @classmethod
    def unjudged(cls, count: int) -> Judgement:
        """Of frames that nothing is known of."""
        return cls(torch.ones(count), torch.ones(count), torch.ones(count, dtype=torch.float64))


class FitData:
    """A capture as a fit sees it. Components correct it before the model is made.

    Args:
        training: what may be seen of the capture.
        device: where the fit runs.

    Attributes:
        training: with corrected poses, where the fit corrects them.
        templates: by side, of the hand model.
        subject: how the person's hand differs from them; None: not at all.
        judgement: of the frames.
        exact_poses: whether the fitted frames have the poses that were given.
    """

    def __init__(self, training: TrainingCapture, device: torch.device) -> None:
        self.training = training
        self.device = device
        self.templates = {side: training.template(side) for side in training.sides}
        self.subject: SubjectShape | None = None
        self.exact_poses = True

    @functools.cached_property
    def frames(self) -> TrainingFrames:
        """The R frames that are fitted."""
        return load_frames(self.training)

    @functools.cached_property
    def mean_color(self) -> Tensor:
        """(3,) sRGB in [0, 1] of the visible hand, by the masks that are given."""
        return self.frames.mean_color()

    @functools.cached_property
    def judges(self) -> TrainingFrames | None:
        """Validation frames, which no step sees; None where they are too few to choose anything."""
        return load_judges(self.training)

    @functools.cached_property
    def judgement(self) -> Judgement:
        """Of the frames; a pre-pass puts its own in place of this one."""
        return Judgement.unjudged(len(self.frames))

    def replace_masks(self, masks: Tensor) -> None:
        """Fit to other masks; the mean colour stays that of the given ones.

        Args:
            masks: (R, H, W) uint8, 255 = hand.
        """
        _ = self.mean_color
        self.frames = dataclasses.replace(self.frames, masks=masks)

    def pose(self, rigs: Mapping[str, HandRig]) -> TrainingClip:
        """Hands and cameras of the frames, posed once."""
        return TrainingClip(self.training, self.frames.indices, rigs, self.device)

    @property
    def bent(self) -> dict[str, HandTemplate]:
        """The person's hands, by side; the templates where no shape is fitted."""
        if self.subject is None:
            return dict(self.templates)
        return {side: self.subject.applied(template) for side, template in self.templates.items()}

    @functools.cached_property
    def places(self) -> list[np.ndarray]:
        """The place of the skin at each pixel of the frames, see `skin_places`."""
        return skin_places(self.training, self.frames, self.bent)

    @functools.cached_property
    def images(self) -> FrameTable:
        """(H, W, 3) sRGB of each frame, black outside the mask."""
        return self.frames.images_on(self.device)

    @functools.cached_property
    def masks(self) -> FrameTable:
        """(H, W) coverage of the visible hand in each frame."""
        return self.frames.masks_on(self.device)

    @functools.cached_property
    def whole_images(self) -> FrameTable:
        """(H, W, 3) sRGB of each frame, its background included."""
        images, device = self.frames.images, self.device
        size = 4 * images[0].numel()
        return FrameTable(
            lambda rows: shares_of_255(images[rows], device), len(images), size, device
        )

    @functools.cached_property
    def silhouettes(self) -> FrameTable:
        """(H, W) bool, where the posed hands would be seen if nothing covered them."""
        drawn = torch.from_numpy(np.stack(self.places) > 0)
        device = self.device
        return FrameTable(
            lambda rows: upload(drawn[rows], device), len(drawn), drawn[0].numel(), device
        )

    def uncovered(self, rows: Tensor) -> Tensor | None:
        """(B, H, W) in [0, 1], the pre-pass's weights of the pixels of B frames; None: all 1."""
        pixels = self.judgement.pixels
        return None if pixels is None else shares_of_255(pixels[rows], self.device)

    def visible(self, rows: Tensor) -> Tensor:
        """How much each pixel of some frames shows the hand, (B, H, W) in [0, 1].

        Args:
            rows: (B,) int64, which of the R frames; on the CPU.
        """
        hand, uncovered = self.masks(rows), self.uncovered(rows)
        if uncovered is not None:
            hand = hand * uncovered
        return hand * self.judgement.frame_weights[rows].to(hand)[:, None, None]


def skin_places(
    training: TrainingCapture, frames: TrainingFrames, templates: Mapping[str, HandTemplate]
) -> list[np.ndarray]:
    """Number the places of a hand, and find the one that each pixel shows.

    Returns:
        R times (H, W) uint16: 0 where the posed hands are not, else the place, numbered without
        gaps over all frames.
    """
    surfaces = HandSurfaces(templates, PLACE)
    size = (training.height, training.width)
    cameras = training.cameras
    shown = np.zeros(len(surfaces.cell_normals) + 1, dtype=bool)
    shown[0] = True
    found = []
    for drawn in surfaces.footprints(
        training.hands, cameras.Ks, cameras.viewmats, frames.indices, size
    ):
        places = np.zeros(size[0] * size[1], dtype=np.int32)
        places[drawn.pixels] = drawn.cells + 1
        shown[drawn.cells + 1] = True
        found.append(places)
    numbers = (np.cumsum(shown) - 1).astype(np.uint16)
    return [numbers[places].reshape(size) for places in found]
