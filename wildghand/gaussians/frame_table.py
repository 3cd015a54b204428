"""Numbers that belong to frames, ready where a fit runs, so that no step waits for them."""

from __future__ import annotations

from collections.abc import Callable

import torch

#: Most memory of a table of frames, bytes: some 1,000 images of 176 px.
TABLE_BYTES = 384 * 1024 * 1024

# Frames whose numbers are made together.
_CHUNK = 32


class FrameTable:
    """Numbers that belong to R frames and do not change: made once, when they are first asked for.

    Args:
        make: takes rows, (B,) int64 on the CPU, and makes what belongs to them, on the device.
        count: R.
        size: bytes of what belongs to one frame.
        device: where it lives.
        cache_bytes: most memory; a larger table is made batch by batch.
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
        """What belongs to B frames, (B, ...); it must not be changed.

        Args:
            rows: (B,) int64 on the CPU.
        """
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
    """Weights of pixels: 1 where the hand is visible, less outside.

    Args:
        masks: coverage in [0, 1].
        outside: weight of a pixel that the mask leaves out.
    """
    return outside + (1.0 - outside) * masks


def shares_of_255(values: torch.Tensor, device: torch.device) -> torch.Tensor:
    """8-bit numbers on the host as float32 shares of 255 on a device."""
    return upload(values, device).float() / 255.0


def upload(tensor: torch.Tensor, device: torch.device) -> torch.Tensor:
    """Copy a tensor from the host without waiting for the device.

    Args:
        tensor: on the CPU.
        device: where the copy lives; for the CPU it is the tensor itself.
    """
    if device.type == "cpu":
        return tensor
    held = tensor.pin_memory() if device.type == "cuda" else tensor
    return held.to(device, non_blocking=True)
