"""The regions y_u of images: one label for each pixel, and which labels a region is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.gaussians.training import TABLE_BYTES, upload

#: Most labels of one image; they are stored as 16-bit numbers.
MAX_LABELS = 65536


@dataclass(frozen=True, eq=False)
class FrameRegions:
    """U regions of one image.

    Regions that do not overlap are their labels. Regions that do (Segment Anything's) are unions
    of atoms, the sets of pixels that lie in the same regions; then labels number the atoms.
    """

    #: (H, W) uint16, 0 to A - 1.
    labels: np.ndarray
    #: (A, U) bool, whether an atom lies in a region; None where atom u is region u.
    membership: np.ndarray | None = None

    @property
    def count(self) -> int:
        """U."""
        return self.atoms if self.membership is None else self.membership.shape[1]

    @property
    def atoms(self) -> int:
        """A."""
        if self.membership is not None:
            return len(self.membership)
        return int(self.labels.max()) + 1 if self.labels.size else 0


def partition(labels: np.ndarray) -> FrameRegions:
    """Regions that cover the image without overlap.

    Args:
        labels: (H, W) integers, any values; they are renumbered from 0 without gaps.
    """
    if labels.ndim != 2 or labels.dtype.kind not in "iu":
        raise UsageError(f"are {labels.dtype} of shape {labels.shape}", field="labels")
    values, numbered = np.unique(labels, return_inverse=True)
    _check_count(len(values))
    return FrameRegions(numbered.reshape(labels.shape).astype(np.uint16))


def overlapping(masks: np.ndarray) -> FrameRegions:
    """Regions that may overlap and may leave pixels out.

    Args:
        masks: (U, H, W) bool; U may be 0.
    """
    if masks.ndim != 3 or masks.dtype != np.bool_:
        raise UsageError(f"are {masks.dtype} of shape {masks.shape}", field="masks")
    count, height, width = masks.shape
    # Pixels with the same bits are one atom. The last bit is never set: no regions at all are
    # then no special case.
    bits = np.zeros((height * width, count + 1), dtype=bool)
    bits[:, :count] = masks.reshape(count, height * width).T
    packed = np.packbits(bits, axis=1)
    rows = packed.view(np.dtype((np.void, packed.shape[1]))).ravel()
    _, first, labels = np.unique(rows, return_index=True, return_inverse=True)
    _check_count(len(first))
    membership = np.ascontiguousarray(bits[first, :count])
    return FrameRegions(labels.reshape(height, width).astype(np.uint16), membership)


def _check_count(count: int) -> None:
    if count > MAX_LABELS:
        raise UsageError(
            f"there are {count} regions", field="labels", remedy=f"At most {MAX_LABELS}."
        )


@dataclass(frozen=True, eq=False)
class Regions:
    """The regions of B frames of one size, ready for sums; regions that a frame lacks are empty."""

    #: (B, H, W) int64: atom of each pixel, plus A for each frame before its own.
    index: Tensor
    #: A, atoms that each frame is given.
    atoms: int
    #: (B, A, U) of 0 and 1; None where atom u is region u.
    membership: Tensor | None = None
    #: (B, U) pixels of each region, where they are known already.
    known_sizes: Tensor | None = None

    @property
    def count(self) -> int:
        """U."""
        return self.atoms if self.membership is None else self.membership.shape[2]

    def sizes(self) -> Tensor:
        """Pixels of each region, (B, U) float32."""
        if self.known_sizes is not None:
            return self.known_sizes
        return self.sums(torch.ones(self.index.shape, device=self.index.device))

    def sums(self, values: Tensor) -> Tensor:
        """Sum of the pixels of each region.

        Args:
            values: (B, H, W) float.

        Returns:
            (B, U), differentiable in `values`.
        """
        index, numbers = self.index.flatten(), values.flatten()
        places = len(self.index) * self.atoms
        if index.device.type == "cpu" and not numbers.requires_grad:
            total = torch.bincount(index, numbers, minlength=places)
        else:  # a count has no gradient, and would wait for a device
            total = numbers.new_zeros(places).index_add(0, index, numbers)
        total = total.reshape(len(self.index), self.atoms)
        if self.membership is None:
            return total
        return torch.einsum("ba,bau->bu", total, self.membership.to(total))

    def spread(self, values: Tensor) -> Tensor:
        """Sum over regions of value times mask.

        Args:
            values: (B, U) float.

        Returns:
            (B, H, W), differentiable in `values`.
        """
        if self.membership is not None:
            values = torch.einsum("bu,bau->ba", values, self.membership.to(values))
        # Its gradient is a sum, which that of an index is not on the CPU.
        return values.flatten().index_select(0, self.index.flatten()).view(self.index.shape)


def stack_regions(frames: Sequence[FrameRegions], device: torch.device | str = "cpu") -> Regions:
    """Put the regions of B frames together."""
    sizes = {frame.labels.shape for frame in frames}
    if len(sizes) != 1:
        raise ShapeMismatch(f"have the sizes {sorted(sizes)}", field="frames")
    atoms, place = max(frame.atoms for frame in frames), torch.device(device)
    labels = torch.from_numpy(np.stack([frame.labels for frame in frames]).astype(np.int64))
    index = labels + atoms * torch.arange(len(frames))[:, None, None]
    if all(frame.membership is None for frame in frames):
        return Regions(upload(index, place), atoms)
    membership = torch.zeros(len(frames), atoms, max(frame.count for frame in frames))
    for frame, made in zip(frames, membership, strict=True):
        member = np.eye(frame.atoms) if frame.membership is None else frame.membership
        made[: member.shape[0], : member.shape[1]] = torch.from_numpy(member.astype(np.float32))
    return Regions(upload(index, place), atoms, upload(membership, place))


class ClipRegions:
    """The regions of all R frames of a clip, where a fit runs; it takes those of a batch from them.

    Args:
        frames: all of one image size, at least one.
        device: where the tensors live.
        cache_bytes: most memory; the regions of a larger clip are put together batch by batch.
    """

    def __init__(
        self,
        frames: Sequence[FrameRegions],
        device: torch.device,
        cache_bytes: int = TABLE_BYTES,
    ) -> None:
        self._frames, self._device = frames, device
        self._whole: Regions | None = None
        if 8 * len(frames) * frames[0].labels.size <= cache_bytes:
            whole = stack_regions(frames, device)
            # Atoms are numbered frame by frame here, and through the batch where they are used.
            first = whole.atoms * torch.arange(len(frames), device=device)
            self._whole = Regions(
                whole.index - first[:, None, None], whole.atoms, whole.membership, whole.sizes()
            )

    def __call__(self, rows: Tensor) -> Regions:
        """The regions of B frames.

        Args:
            rows: (B,) int64 on the CPU, which of the frames.
        """
        whole = self._whole
        if whole is None:
            return stack_regions([self._frames[row] for row in rows.tolist()], self._device)
        assert whole.known_sizes is not None
        if len(rows) == 1:  # views
            part = slice(int(rows[0]), int(rows[0]) + 1)
            member = None if whole.membership is None else whole.membership[part]
            return Regions(whole.index[part], whole.atoms, member, whole.known_sizes[part])
        first = upload(whole.atoms * torch.arange(len(rows)), self._device)
        rows = upload(rows, self._device)
        member = None if whole.membership is None else whole.membership[rows]
        index = whole.index[rows] + first[:, None, None]
        return Regions(index, whole.atoms, member, whole.known_sizes[rows])
