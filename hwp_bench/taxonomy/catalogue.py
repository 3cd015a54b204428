"""The eleven captures of the HWP data set, as the paper's dataset table lists them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType


@dataclass(frozen=True)
class CatalogueEntry:
    """One row of the paper's dataset table."""

    #: `capture0` to `capture10`.
    id: str
    #: `single` or `interacting`.
    hands: str
    #: Action of the hands.
    action: str
    #: `Mobile phone` (handheld) or `Webcam` (fixed).
    device: str
    #: Frames of the real capture.
    frame_count: int
    #: Names of the perturbations that it carries, in the order of `PERTURBATIONS`.
    perturbations: tuple[str, ...]


@cache
def catalogue() -> MappingProxyType[str, CatalogueEntry]:
    """Return the captures by id, in the paper's order; 13,821 frames in all."""
    text = resources.files("hwp_bench.taxonomy").joinpath("catalogue.json").read_text("utf-8")
    rows = json.loads(text)["captures"]
    entries = [
        CatalogueEntry(**{**row, "perturbations": tuple(row["perturbations"])}) for row in rows
    ]
    return MappingProxyType({entry.id: entry for entry in entries})
