"""The choice of a capture's hands, and warnings about unexpected records."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.base.images import read_gray
from hwp_bench.importers.official.crop import MASK_THRESHOLD
from hwp_bench.importers.official.folders import OfficialFolder
from hwp_bench.importers.official.release_records import OfficialRecords
from hwp_bench.taxonomy import catalogue

#: Fewest joints on the mask (mean share), and lead over the other hand, to decide.
MIN_SHARE, MIN_LEAD = 0.5, 0.1
#: Number of frames that are examined.
LOOKED_AT = 24


def unexpected(folder: OfficialFolder, records: OfficialRecords) -> list[str]:
    """List contradictions to the paper or the format that still let the records be used."""
    found = [f"unknown key {key!r} is not read" for key in records.unknown]
    if records.reordered:
        found.append("records were not in the order of their images; they are now")
    entry = catalogue().get(folder.id)
    if entry is None:
        found.append(f"{folder.id} is not one of the paper's captures: perturbations unknown")
        return found
    if (entry.hands == "single") != folder.single:
        found.append(f"the folder's name contradicts the paper: {folder.id} is {entry.hands}")
    most = -(-entry.frame_count // (folder.subsample or 1))
    if len(records.numbers) > most:
        found.append(f"{len(records.numbers)} frames, where the paper's count gives {most}")
    return found


def choose_sides(
    folder: OfficialFolder, records: OfficialRecords, hand: str | None
) -> tuple[tuple[str, ...], list[str]]:
    """Decide which hands the capture has.

    The tracker writes both hands in every capture. Of a single-hand capture it
    is the hand whose joints lie on the masks, unless `hand` names it.

    Args:
        folder: the folder.
        records: its records.
        hand: the user's choice, or None.

    Returns:
        The sides, and messages to the user about the choice.

    Raises:
        BadInput: a hand is missing or not finite in any frame, or the masks do not decide.
    """
    entry = catalogue().get(folder.id)
    single = entry.hands == "single" if entry else folder.single
    if not single:
        if set(records.sides) != {"right", "left"}:
            raise BadInput(
                f"has the {', '.join(records.sides)} hand only, for a capture of two",
                where=folder.path,
            )
        _need_valid(folder, records, ("right", "left"))
        return ("right", "left"), []
    if hand is not None:
        if hand not in records.sides:
            raise BadInput(f"has no {hand} hand", where=folder.path, field="--hand")
        _need_valid(folder, records, (hand,))
        return (hand,), []
    if len(records.sides) == 1:
        side = next(iter(records.sides))
        _need_valid(folder, records, (side,))
        return (side,), []
    shares = {side: _share_on_mask(records, side) for side in records.sides}
    side = max(shares, key=lambda name: shares[name])
    listed = ", ".join(f"{name} {share:.2f}" for name, share in shares.items())
    if shares[side] < MIN_SHARE or shares[side] - min(shares.values()) < MIN_LEAD:
        raise BadInput(
            f"the masks do not show which hand is in the image (share of joints on them: {listed})",
            where=folder.path,
            remedy="Name the hand with --hand.",
        )
    _need_valid(folder, records, (side,))
    return (side,), [f"{side} hand taken, by the share of joints on the masks: {listed}"]


def _need_valid(folder: OfficialFolder, records: OfficialRecords, sides: tuple[str, ...]) -> None:
    for side in sides:
        if not records.sides[side].valid.any():
            raise BadInput(f"the {side} hand is not finite in any frame", where=folder.path)


def _share_on_mask(records: OfficialRecords, side: str) -> float:
    """Mean share of a hand's joints that lie on the mask, over a few frames."""
    hand = records.sides[side]
    frames = np.flatnonzero(hand.valid)
    if not len(frames):
        return 0.0
    shares = []
    for frame in frames[np.unique(np.linspace(0, len(frames) - 1, LOOKED_AT).astype(int))]:
        mask = read_gray(records.masks[frame]) > MASK_THRESHOLD
        x, y = np.floor(hand.landmarks[frame].T).clip(-1, 1e6).astype(int)
        inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
        shares.append(
            np.mean(inside & mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)])
        )
    return float(np.mean(shares))
