"""Check a revealed suite: its captures are made again from the secret and compared."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import split_for
from hwp_bench.methods.request import open_request
from hwp_bench.publish.commitment import commitment, target_content
from hwp_bench.publish.sealed import read_manifest
from hwp_bench.sealed.files import SuitePage, read_suite_page
from hwp_bench.sealed.make import suite_salt
from hwp_bench.sealed.recipe import sealed_items
from hwp_bench.sealed.reveal import read_revealed
from hwp_bench.sealed.secret import secret_commitment
from hwp_bench.sim.produce.suites import ensure_captures


@dataclass(frozen=True)
class CheckedCapture:
    """One capture that was made again."""

    #: Its id.
    id: str
    #: Whether test frames, masks and split are those that the manifest is committed to.
    hidden: bool
    #: Training and validation frames of the public part that differ from the new ones.
    different: int
    #: Largest difference of these frames, levels of 255.
    levels: int

    @property
    def same(self) -> bool:
        """Whether nothing differs."""
        return self.hidden and not self.different


@dataclass(frozen=True)
class Checked:
    """Captures that were made again and compared; the secret itself fits its commitment."""

    #: The page of the suite.
    page: SuitePage
    #: Captures that were made again, in the recipe's order.
    captures: tuple[CheckedCapture, ...]

    @property
    def holds(self) -> bool:
        """Whether every capture that was made again is the same."""
        return all(capture.same for capture in self.captures)


def check_revealed(
    public: str | os.PathLike[str],
    revealed: str | os.PathLike[str],
    work: str | os.PathLike[str],
    *,
    only: Collection[str] | None = None,
    workers: int | None = None,
) -> Checked:
    """Check a revealed secret against what was published before.

    Args:
        public: the part for authors, as it was published.
        revealed: the file that `reveal` wrote.
        work: folder of the captures that are made again; those that are there are taken.
        only: ids of captures to make again; None takes all, an empty one none.
        workers: processes for each render.

    Raises:
        BadInput: the secret is not the one that the page is committed to, or the page does not
            belong to the manifest.
        UsageError: this toolkit renders other captures than its maker's, or `only` names none.
    """
    page, found = read_suite_page(public), read_revealed(revealed)
    expected = secret_commitment(found.secret, page.recipe.to_json())
    if not expected == page.secret_commitment == found.secret_commitment:
        raise BadInput(
            "is not the secret that the suite was committed to",
            where=revealed,
            remedy="Its organiser exchanged the secret, or the files are of different suites.",
        )
    manifest = read_manifest(public)
    if manifest.commitment != page.frames_commitment:
        raise BadInput("is not of the manifest next to it", where=public, field="commitment")
    items = sealed_items(page.recipe, found.secret)
    ids = [item.scene.id for item in items]
    if [entry.id for entry in manifest.captures] != ids:
        raise BadInput("has other captures than the recipe", where=public, field="captures")
    if only is not None and (unknown := sorted(set(only) - set(ids))):
        raise UsageError(
            f"{unknown[0]!r} is not a capture of the suite",
            field="--capture",
            remedy=f"Known: {', '.join(ids)}.",
        )
    chosen = [item for item in items if only is None or item.scene.id in only]
    if chosen:
        page.recipe.refuse_other_toolkit()
    made = ensure_captures(chosen, work, workers)
    committed = {entry.id: entry.commitment for entry in manifest.captures}
    captures = [open_capture(folder) for folder in made]
    return Checked(
        page,
        tuple(
            _compare(Path(public), capture, committed[capture.info.id], suite_salt(found.secret))
            for capture in captures
        ),
    )


def _compare(public: Path, capture: Capture, committed: str, salt: str) -> CheckedCapture:
    name = capture.info.id
    split = split_for(name, len(capture))
    content = target_content(capture, split)
    hidden = commitment(content, salt) == committed
    given = open_request(public / name)
    different = levels = 0
    for frame in [*split.train.tolist(), *split.validation.tolist()]:
        for ours, theirs in (
            (capture.frame(frame), given.frame(frame)),
            (capture.mask(frame), given.mask(frame)),
        ):
            gap = int(np.abs(ours.astype(int) - theirs.astype(int)).max())
            different += gap > 0
            levels = max(levels, gap)
    return CheckedCapture(name, hidden, different, levels)
