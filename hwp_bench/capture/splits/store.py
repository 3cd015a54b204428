"""Split files: one JSON file holds the splits of a set of captures."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from hwp_bench.base.errors import BadSplit
from hwp_bench.base.files import read_json, write_json
from hwp_bench.capture.splits.split import Split, contiguous_split

#: Version of the split files.
SCHEMA = "hwp-splits/1"


def read_splits(path: str | os.PathLike[str]) -> Mapping[str, Split]:
    """Read a split file.

    Returns:
        The splits by capture id.

    Raises:
        BadInput: missing or damaged.
        BadSplit: a split is not sound, or its digest does not match.
    """
    value = read_json(path)
    where = os.fspath(path)
    if not isinstance(value, dict) or value.get("schema") != SCHEMA:
        raise BadSplit(f"is no split file of schema {SCHEMA}", where=where)
    if not isinstance(value.get("splits"), list):
        raise BadSplit("must be a list", where=where, field="splits")
    splits: dict[str, Split] = {}
    for item in value["splits"]:
        split = Split.from_json(item, where=where)
        if split.capture in splits:
            raise BadSplit(f"{split.capture} is listed twice", where=where)
        splits[split.capture] = split
    return splits


def write_splits(path: str | os.PathLike[str], splits: Iterable[Split]) -> Path:
    """Write a split file atomically."""
    return write_json(path, {"schema": SCHEMA, "splits": [split.to_json() for split in splits]})


def split_for(
    capture_id: str, frame_count: int, splits: Mapping[str, Split] | None = None
) -> Split:
    """Return the split that a capture is evaluated with.

    Args:
        capture_id: id of the capture.
        frame_count: its number of frames.
        splits: splits by capture id; without them the 80/10/10 rule is applied.

    Raises:
        BadSplit: the capture is not listed, is listed with another length, or is too short.
    """
    if splits is None:
        return contiguous_split(capture_id, frame_count)
    if capture_id not in splits:
        raise BadSplit(
            "is not in the split file",
            where=capture_id,
            remedy=f"The file lists: {', '.join(sorted(splits))}.",
        )
    split = splits[capture_id]
    if split.frame_count != frame_count:
        raise BadSplit(
            f"has {frame_count} frames where its split is made for {split.frame_count}",
            where=capture_id,
            remedy="Use the capture that the split belongs to.",
        )
    return split
