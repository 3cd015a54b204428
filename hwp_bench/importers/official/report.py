"""The numbers by which an import of the release is judged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.importers.official.crop import CroppedFrame
from hwp_bench.importers.official.folders import OfficialFolder
from hwp_bench.importers.official.hands import ImportedHand
from hwp_bench.importers.official.records import OfficialRecords
from hwp_bench.importers.posed import PosedClip

if TYPE_CHECKING:
    from hwp_bench.importers.official.importing import OfficialImport

#: Joints that miss the tracker's by more than this share of the frame are told.
FAR_JOINTS = 0.1


def import_facts(
    folder: OfficialFolder,
    records: OfficialRecords,
    hands: Mapping[str, ImportedHand],
    clips: Mapping[str, PosedClip],
    tracked: np.ndarray,
    crops: list[CroppedFrame],
    warnings: list[str],
    options: OfficialImport,
) -> dict[str, Any]:
    """Measure the hands against the records; what looks wrong goes to `warnings` too.

    Returns:
        JSON: mean distance from the tracker's vertices (mm) and joints (px of the crop), share
        of the vertices on the masks, and the warnings.
    """
    gaps, on_mask = {}, {}
    for index, (side, clip) in enumerate(clips.items()):
        valid = hands[side].hand.valid
        gap = np.linalg.norm(clip.landmarks - tracked[:, 21 * index : 21 * index + 21], axis=-1)
        gaps[side] = round(float(gap[valid].mean()), 3)
        on_mask[side] = round(_vertices_on_masks(clip, crops, valid), 4)
        if gaps[side] > FAR_JOINTS * options.size:
            warnings.append(
                f"the {side} hand's joints lie {gaps[side]:.0f} px from joints2d_world_{side}: "
                "focal length or principal point may follow another convention"
            )
    return {
        "capture": folder.id,
        "frames": len(records.numbers),
        "subsample": folder.subsample,
        "hands": list(hands),
        "hand_model": "anny" if options.mano is None else "mano",
        "official_compat": options.official_compat,
        "frames_valid": {side: int(made.hand.valid.sum()) for side, made in hands.items()},
        "vertex_error_mm": {
            side: round(float(np.nanmean(made.error_mm)), 3) for side, made in hands.items()
        },
        "joint_error_px": gaps,
        "vertices_on_mask": on_mask,
        "warnings": warnings,
    }


def _vertices_on_masks(clip: PosedClip, crops: list[CroppedFrame], valid: np.ndarray) -> float:
    """Mean share of projected vertices that lie on the hand's mask, of those in the picture."""
    shares = []
    for frame in np.flatnonzero(valid):
        mask = crops[frame].mask
        x, y = np.floor(clip.pixels[frame].T).clip(-1, 1e6).astype(int)
        inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
        if inside.any():
            shares.append(float((mask[y[inside], x[inside]] > 127).mean()))
    return float(np.mean(shares)) if shares else 0.0
