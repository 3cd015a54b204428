"""The training data of a fit in memory: frames as tables, and the posed hands and cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import BadInput
from hwp_bench.capture import Capture
from hwp_bench.methods.contract import TrainingCapture
from wildghand.gaussians.rig import AnchorPoses, HandRig

#: Most memory of a table of frames, bytes: some 1,000 images of 176 px.
TABLE_BYTES = 384 * 1024 * 1024

# Frames whose numbers are made together.
_CHUNK = 32


class FrameTable:
    """Numbers that belong to `count` frames and do not change: made once, when first asked for.

    `make` takes rows, (B,) int64 on the CPU, and makes what belongs to them on the device. A table
    of more than `cache_bytes`, `size` bytes a frame, is made batch by batch.
    """

    def __init__(
        self,
        make: Callable[[torch.Tensor], torch.Tensor],
        count: int,
        size: int,
        device: torch.device,
        cache_bytes: int = TABLE_BYTES,
    ) -> None:
        self._make = make
        self._device = device
        self._all = torch.arange(count if count * size <= cache_bytes else 0)
        self._made: torch.Tensor | None = None

    def __call__(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the values of (B,) rows: (B, ...); they must not be changed."""
        if not len(self._all):
            return self._make(rows)
        if self._made is None:
            self._made = self._make_all()
        if len(rows) == 1:  # a view
            return self._made[int(rows[0])][None]
        return self._made[upload(rows, self._device)]

    def _make_all(self) -> torch.Tensor:
        """Fill the table part by part: joining finished parts would hold all of them twice."""
        parts = self._all.split(_CHUNK)
        first = self._make(parts[0])
        made = first.new_empty(len(self._all), *first.shape[1:])
        made[: len(first)] = first
        for part in parts[1:]:
            made[int(part[0]) : int(part[-1]) + 1] = self._make(part)
        return made


def soft_weights(masks: torch.Tensor, outside: float) -> torch.Tensor:
    """Weights of pixels: 1 where the coverage is 1, `outside` where it is 0."""
    return outside + (1.0 - outside) * masks


def shares_of_255(values: torch.Tensor, device: torch.device) -> torch.Tensor:
    """8-bit numbers on the host as float32 shares of 255 on a device."""
    return upload(values, device).float() / 255.0


def upload(tensor: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Copy a tensor from the host without waiting for the device; the tensor itself for the CPU."""
    if device.type == "cpu":
        return tensor
    held = tensor.pin_memory() if device.type == "cuda" else tensor
    return held.to(device, non_blocking=True)


#: Most memory that posed anchors are kept in, bytes; longer clips are posed step by step.
CACHE_BYTES = 768 * 1024 * 1024

# A position and a quaternion in float32.
_ANCHOR_BYTES = 4 * (3 + 4)


@dataclass(frozen=True, eq=False)
class TrainingFrames:
    """R training frames that can be fitted."""

    #: (R,) which frames of the capture they are.
    indices: np.ndarray
    #: (R, H, W, 3) uint8 sRGB.
    images: torch.Tensor
    #: (R, H, W) uint8, 255 = visible hand.
    masks: torch.Tensor

    def __len__(self) -> int:
        return len(self.indices)

    def images_on(self, device: torch.device) -> FrameTable:
        """Targets of renderings: (H, W, 3) float32, black outside the mask."""

        def make(rows: torch.Tensor) -> torch.Tensor:
            images = upload(self.images[rows], device).float() / 255.0
            return images * shares_of_255(self.masks[rows], device)[..., None]

        return FrameTable(make, len(self), 4 * self.images[0].numel(), device)

    def masks_on(self, device: torch.device) -> FrameTable:
        """Estimated coverage of the visible hand: a table of (H, W) float32 in [0, 1]."""
        each = 4 * self.masks[0].numel()
        return FrameTable(
            lambda rows: shares_of_255(self.masks[rows], device), len(self), each, device
        )

    def mean_color(self) -> torch.Tensor:
        """(3,) mean sRGB colour of the visible hand, in [0, 1]."""
        total = torch.zeros(3, dtype=torch.float64)
        weight = torch.zeros((), dtype=torch.float64)
        for image, mask in zip(self.images, self.masks, strict=True):
            inside = image[mask > 127].double()
            total += inside.sum(dim=0)
            weight += len(inside)
        return (total / weight / 255.0).float()


def load_frames(training: TrainingCapture) -> TrainingFrames:
    """Read the training frames that show a hand and whose parameters are valid.

    Left out are frames in which the estimator of any of the capture's hands failed (the mask
    then covers a hand that cannot be placed) and frames whose mask is empty.

    Raises:
        BadImage: an image is missing or damaged.
        BadInput: no frame is left.
    """
    frames = _read_frames(training, training.train)
    if not len(frames):
        raise BadInput(
            f"none of {len(training.train)} training frames has valid hand parameters and a mask",
            where=training.root,
            remedy="Check the capture with `hwp-bench data show`.",
        )
    return frames


#: Frames that choose, at most and at least: one or two say little.
MOST_CHOOSING, LEAST_CHOOSING = 8, 4


def load_judges(training: TrainingCapture) -> TrainingFrames | None:
    """Read the validation frames that choose, which no step sees; None where they are too few."""
    frames = load_validation_frames(training, MOST_CHOOSING)
    return frames if len(frames) >= LEAST_CHOOSING else None


def load_validation_frames(training: TrainingCapture, most: int) -> TrainingFrames:
    """Read at most so many validation frames, evenly spread over the usable; there may be none.

    What is fitted too is left out.
    """
    apart, valid = np.setdiff1d(training.validation, training.train), _valid(training)
    usable = [f for f in apart.tolist() if valid[f] and _shows_hand(training.mask(f))]
    return _read_frames(training, np.array(usable, np.int64)[evenly(len(usable), most)])


def _valid(training: TrainingCapture) -> np.ndarray:
    """In which frames the parameters of all hands are valid: (F,) bool."""
    return np.all([hand.valid for hand in training.hands.values()], axis=0)


def _shows_hand(mask: np.ndarray) -> bool:
    return bool((mask > 127).any())


def _read_frames(training: TrainingCapture, numbers: np.ndarray) -> TrainingFrames:
    """Read those of the frames that show a hand and whose parameters are valid."""
    valid = _valid(training)
    kept: list[int] = []
    # Filled frame by frame: a list of frames that is stacked in the end would hold all of them
    # twice. Memory of frames that are left out is never touched.
    images = np.empty((len(numbers), training.height, training.width, 3), dtype=np.uint8)
    masks = np.empty((len(numbers), training.height, training.width), dtype=np.uint8)
    for frame in numbers.tolist():
        if not valid[frame]:
            continue
        mask = training.mask(frame)
        if _shows_hand(mask):
            images[len(kept)] = training.frame(frame)
            masks[len(kept)] = mask
            kept.append(frame)
    return TrainingFrames(
        indices=np.array(kept, dtype=np.int64),
        images=torch.from_numpy(images[: len(kept)]),
        masks=torch.from_numpy(masks[: len(kept)]),
    )


class TrainingClip:
    """The given parameters of R frames; they are constant, so anchors are posed once.

    Args:
        training: hand parameters and cameras of the capture.
        indices: (R,) the frames of the capture that are fitted.
        rigs: by side.
        device: where the tensors live.
        cache_bytes: most memory for posed anchors.

    Attributes:
        parameters: by side, pose (R, 16, 3), betas (10,) and transl (R, 3).
        viewmats: (R, 4, 4).
        Ks: (R, 3, 3) px.
    """

    def __init__(
        self,
        training: TrainingCapture | Capture,
        indices: np.ndarray,
        rigs: Mapping[str, HandRig],
        device: torch.device,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        def tensor(array: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(array, dtype=torch.float32, device=device)

        self._rigs = rigs
        self.parameters = {
            side: (
                tensor(training.hands[side].pose[indices]),
                tensor(training.hands[side].betas),
                tensor(training.hands[side].transl[indices]),
            )
            for side in rigs
        }
        self.viewmats = tensor(training.cameras.viewmats[indices])
        self.Ks = tensor(training.cameras.Ks[indices])
        size = len(indices) * sum(len(rig) for rig in rigs.values()) * _ANCHOR_BYTES
        self._cache: dict[str, AnchorPoses] | None = None
        if size <= cache_bytes:
            rows = torch.arange(len(indices), device=device)
            self._cache = {side: self._pose(side, rows) for side in rigs}

    def given(
        self, rows: torch.Tensor
    ) -> dict[str, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
        """The parameters of the hands in (B,) rows, by side: pose, betas and transl."""
        return {
            side: (pose[rows], betas, transl[rows])
            for side, (pose, betas, transl) in self.parameters.items()
        }

    def hand(self, side: str, rows: torch.Tensor) -> AnchorPoses:
        """The anchors of one hand in (B,) rows, without gradient; they must not be changed."""
        if self._cache is None:
            return self._pose(side, rows)
        posed = self._cache[side]
        if len(rows) == 1 and rows.device.type == "cpu":  # views
            row = slice(int(rows[0]), int(rows[0]) + 1)
            return AnchorPoses(posed.positions[row], posed.orientations[row])
        return AnchorPoses(posed.positions[rows], posed.orientations[rows])

    def poses(self, rows: torch.Tensor) -> AnchorPoses:
        """The anchors of all hands in a batch, one hand after the other."""
        return join_hands([self.hand(side, rows) for side in self._rigs])

    def _pose(self, side: str, rows: torch.Tensor) -> AnchorPoses:
        pose, betas, transl = self.parameters[side]
        return self._rigs[side].pose(pose[rows], betas, transl[rows])


def join_hands(hands: list[AnchorPoses]) -> AnchorPoses:
    """The anchors of several hands as those of one."""
    if len(hands) == 1:
        return hands[0]
    return AnchorPoses(
        torch.cat([hand.positions for hand in hands], dim=1),
        torch.cat([hand.orientations for hand in hands], dim=1),
    )
