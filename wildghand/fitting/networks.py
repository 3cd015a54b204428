"""The networks that a fit may use, from files of a person's: chosen by settings, checked early."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from hwp_bench.base.errors import UsageError
from hwp_bench.methods.settings import source_path
from wildghand.gaussians.perceptual import FilterBankLoss, Vgg19
from wildghand.model.settings import WildGHandSettings, read_settings
from wildghand.pao.sam import check_checkpoint, open_sam
from wildghand.pao.segmenters import Segmenter, Superpixels


def check_networks(values: Mapping[str, Any]) -> None:
    """Check the files that settings name: that they are there and hold the right tensors.

    Args:
        values: what `read_settings` takes, with absolute paths.

    Raises:
        BadMethod: a setting is unknown or out of range.
        HwpError: a file is missing, unreadable or of another network.
    """
    settings = read_settings(values)
    for path in {source_path(settings.pao.regions), source_path(settings.pao.hand)} - {None}:
        check_checkpoint(str(path))
    perceptual = source_path(settings.perceptual)
    if perceptual is not None:
        Vgg19(perceptual)  # as light as a check: its tensors stay on the disk


def choose_segmenter(source: str, device: torch.device) -> Segmenter:
    """What cuts frames into regions, as the setting `pao.regions` says.

    Args:
        source: `superpixels` or `sam:PATH`.
        device: where a network runs.

    Raises:
        HwpError: the checkpoint cannot be used.
    """
    path = source_path(source)
    return Superpixels() if path is None else open_sam(path, str(device))


def choose_perceptual(settings: WildGHandSettings, device: torch.device) -> nn.Module | None:
    """The perceptual distance of a fit; None where its weight is 0.

    Raises:
        UsageError: a network was chosen for a term of weight 0.
        HwpError: its weights cannot be used.
    """
    path = source_path(settings.perceptual)
    if not settings.terms.perceptual:
        if path is not None:
            raise UsageError(
                "has no effect, since terms.perceptual is 0",
                field="perceptual",
                remedy="Set terms.perceptual too: 0.001 (mode default), 0.1 (mode paper).",
            )
        return None
    return FilterBankLoss() if path is None else Vgg19(path).to(device)
