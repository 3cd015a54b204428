"""Sealed suites: captures whose seeds nobody knows who has not the organiser's secret.

Made from a drawn secret, published with a page that binds the organiser, revealed once all
submissions are scored, and then checked by anybody who renders the captures again.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import refuse_existing, write_json
from hwp_bench.base.folders import exclusive
from hwp_bench.base.packages import __version__
from hwp_bench.base.records import Digest, Line
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.schema import Cameras
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.commitments.publication import (
    PUBLIC,
    SEALED,
    commitment,
    open_sealed,
    publish,
    read_manifest,
    target_content,
)
from hwp_bench.commitments.recipe import (
    SECRET_BYTES,
    SealedRecipe,
    derived,
    read_secret,
    read_strictly,
    sealed_items,
    secret_commitment,
    write_secret,
)
from hwp_bench.hands import HandParameters
from hwp_bench.methods.contract import TrainingCapture
from hwp_bench.methods.request import open_request
from hwp_bench.run.engine import Engine, Needs
from hwp_bench.sim.produce.capture import ensure_suite

#: Version of the public page.
SUITE_SCHEMA = "hwp-sealed-suite/1"
#: Version of a reveal.
REVEAL_SCHEMA = "hwp-revealed/1"
#: Names inside the folder of a sealed suite. The keeper's part holds the secret and the captures,
#: the publication the part for authors and the sealed part that scores them.
KEEPER, SECRET, CAPTURES, PUBLICATION = "keeper", "secret.json", "captures", "publication"
#: By how much hand parameters and cameras may differ: another machine may round otherwise.
_ROUNDING = 1e-5
#: The page, inside the part for authors.
SUITE = "suite.json"


@dataclass(frozen=True)
class SuitePage:
    """The page that is published before anybody submits: the recipe, and two commitments."""

    recipe: SealedRecipe
    #: Binds the secret and the recipe (`secret.secret_commitment`).
    secret_commitment: Digest
    #: Binds test frames and masks of all captures, the public manifest's `commitment`.
    frames_commitment: Digest
    #: Version of the toolkit that made it.
    toolkit: Line


def write_suite_page(folder: Path, page: SuitePage) -> None:
    """Write the page into the part for authors."""
    write_json(folder / SUITE, {"schema": SUITE_SCHEMA, **asdict(page)})


def read_suite_page(public: str | os.PathLike[str]) -> SuitePage:
    """Read the page of a part for authors."""
    path = Path(public) / SUITE
    if not path.is_file():
        raise BadInput(
            f"holds no {SUITE}",
            where=public,
            remedy="Give the folder public of a suite that `hwp-bench challenge make` made.",
        )
    return read_strictly(path, SUITE_SCHEMA, SuitePage)


@dataclass(frozen=True)
class SealedSuite:
    """A sealed suite that was made."""

    public: Path
    #: Part that scores submissions; stays with the organiser.
    sealed: Path
    #: File of the secret; stays with the organiser until it is revealed.
    secret: Path
    #: The page that binds the organiser, as `public` holds it.
    page: SuitePage


def make_suite(
    out: str | os.PathLike[str],
    recipe: SealedRecipe,
    *,
    secret: str | None = None,
    workers: int | None = None,
    engine: Engine | None = None,
    needs: Needs | None = None,
) -> SealedSuite:
    """Make a sealed suite in a folder; started again it continues where it was stopped."""
    folder = Path(out)
    refuse_existing(folder / PUBLICATION)
    keeper = folder / KEEPER
    with exclusive(folder):
        keeper.mkdir(exist_ok=True)
        keeper.chmod(0o700)
        hidden = _secret_of(keeper / SECRET, secret)
        items = sealed_items(recipe, hidden)
        captures = ensure_suite(items, keeper / CAPTURES, workers, engine=engine, needs=needs)

        def describe(public: Path, joint: str) -> None:
            write_suite_page(public, _page(recipe, hidden, joint))

        made = publish(captures, folder / PUBLICATION, salt=suite_salt(hidden), describe=describe)
    page = _page(recipe, hidden, made.commitment)
    return SealedSuite(
        folder / PUBLICATION / PUBLIC, folder / PUBLICATION / SEALED, keeper / SECRET, page
    )


def suite_salt(secret: str) -> str:
    """Return the salt (hex) of the commitment to a suite's frames."""
    return derived(secret, "salt").hex()


def _page(recipe: SealedRecipe, secret: str, joint: str) -> SuitePage:
    return SuitePage(recipe, secret_commitment(secret, asdict(recipe)), joint, __version__)


def _secret_of(path: Path, given: str | None) -> str:
    """Return the secret of a suite; it is kept before anything is rendered with it."""
    if path.is_file():
        kept = read_secret(path)
        if given not in (None, kept):
            raise BadInput(
                "is another secret than the one that was given",
                where=path,
                remedy="Give the same secret again, or another folder with -o.",
            )
        return kept
    chosen = given or secrets.token_hex(SECRET_BYTES)
    write_secret(path, chosen)
    return chosen


@dataclass(frozen=True)
class Revealed:
    """A revealed secret."""

    #: The secret, hex.
    secret: Digest
    #: The commitment of the page that it was made for.
    secret_commitment: Digest


def reveal(suite: str | os.PathLike[str], out: str | os.PathLike[str]) -> Revealed:
    """Write the file that reveals a suite's secret."""
    folder = Path(suite)
    target = Path(out)
    refuse_existing(target)
    page = read_suite_page(folder / PUBLICATION / PUBLIC)
    secret = read_secret(folder / KEEPER / SECRET)
    if secret_commitment(secret, asdict(page.recipe)) != page.secret_commitment:
        raise BadInput(
            "is not the secret that the suite's page is committed to",
            where=folder / KEEPER / SECRET,
        )
    if open_sealed(folder / PUBLICATION).commitment != page.frames_commitment:
        raise BadInput(
            "is not the sealed part that the suite's page is committed to",
            where=folder / PUBLICATION,
        )
    found = Revealed(secret, page.secret_commitment)
    write_json(target, {"schema": REVEAL_SCHEMA, **asdict(found)})
    return found


def read_revealed(path: str | os.PathLike[str]) -> Revealed:
    """Read a revealed secret."""
    return read_strictly(path, REVEAL_SCHEMA, Revealed)


@dataclass(frozen=True)
class CheckedCapture:
    """One capture that was made again."""

    id: str
    #: Whether test frames, masks and split are those that the manifest is committed to.
    hidden: bool
    #: Training and validation frames of the public part that differ from the new ones.
    different: int
    #: Largest difference of these frames, levels of 255; 255 where their sizes differ.
    levels: int
    #: Whether hand parameters, cameras and the split of the public part are the new ones.
    numbers: bool

    @property
    def same(self) -> bool:
        """Whether nothing differs."""
        return self.hidden and not self.different and self.numbers


@dataclass(frozen=True)
class Checked:
    """Captures that were made again and compared; the secret itself fits its commitment."""

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
    """Check a revealed secret against what was published before."""
    page, found = read_suite_page(public), read_revealed(revealed)
    expected = secret_commitment(found.secret, asdict(page.recipe))
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
    committed = {entry.id: entry.commitment for entry in manifest.captures}
    salt = suite_salt(found.secret)
    captures = [open_capture(folder) for folder in ensure_suite(chosen, work, workers)]
    return Checked(
        page,
        tuple(_compare(Path(public), one, committed[one.info.id], salt) for one in captures),
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
            gap = 255
            if ours.shape == theirs.shape:
                gap = int(np.abs(ours.astype(int) - theirs.astype(int)).max())
            different += gap > 0
            levels = max(levels, gap)
    return CheckedCapture(name, hidden, different, levels, _same_numbers(capture, split, given))


def _same_numbers(capture: Capture, split: Split, given: TrainingCapture) -> bool:
    """Whether hands, cameras and split of a capture are those of the public part."""
    ours, theirs = [_numbers(one.hands, one.cameras) for one in (capture, given)]
    clip, views = capture.free_view, given.free_views
    if (clip is None) != (views is None) or split != given.split:
        return False
    if clip is not None and views is not None:
        ours += _numbers(clip.hands, clip.cameras)
        theirs += _numbers(views.hands, views.cameras)
    return len(ours) == len(theirs) and all(
        one.shape == other.shape and np.allclose(one, other, rtol=0, atol=_ROUNDING)
        for one, other in zip(ours, theirs, strict=True)
    )


def _numbers(hands: Mapping[str, HandParameters], cameras: Cameras) -> list[np.ndarray]:
    arrays = [cameras.Ks, cameras.viewmats]
    for _, hand in sorted(hands.items()):
        arrays += [hand.pose, hand.betas, hand.transl, hand.valid]
    return arrays
