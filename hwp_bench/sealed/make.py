"""Make a sealed suite: draw a secret, render what follows from it, publish one part of it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import refuse_existing
from hwp_bench.base.folders import exclusive
from hwp_bench.base.packages import __version__
from hwp_bench.publish import publish
from hwp_bench.publish.parts import PUBLIC, SEALED
from hwp_bench.run.engine import Engine, Needs
from hwp_bench.sealed.files import (
    CAPTURES,
    KEEPER,
    PUBLICATION,
    SECRET,
    SuitePage,
    write_suite_page,
)
from hwp_bench.sealed.recipe import Recipe, sealed_items
from hwp_bench.sealed.secret import (
    derived,
    draw_secret,
    read_secret,
    secret_commitment,
    write_secret,
)
from hwp_bench.sim.produce.suites import ensure_captures


@dataclass(frozen=True)
class SealedSuite:
    """A sealed suite that was made."""

    #: Part for authors.
    public: Path
    #: Part that scores submissions; stays with the organiser.
    sealed: Path
    #: File of the secret; stays with the organiser until it is revealed.
    secret: Path
    #: The page that binds the organiser, as `public` holds it.
    page: SuitePage


def make_suite(
    out: str | os.PathLike[str],
    recipe: Recipe,
    *,
    secret: str | None = None,
    workers: int | None = None,
    engine: Engine | None = None,
    needs: Needs | None = None,
) -> SealedSuite:
    """Make a sealed suite in a folder; started again it goes on where it was stopped.

    Args:
        out: folder of the suite: `keeper/` with the secret and the captures, readable by its owner
            alone, and `publication/` with `public/` and `sealed/`.
        recipe: its scenes.
        secret: hex; None draws one, or takes the one of a start that was stopped.
        workers: processes for each render.
        engine: where captures are rendered; one after another in this process if None.
        needs: what one render takes of a machine.

    Raises:
        UsageError: the suite is there already.
        BadInput: a start that was stopped had another secret.
        HwpError: a render failed, or nothing can be written; what was rendered stays.
    """
    folder = Path(out)
    refuse_existing(folder / PUBLICATION)
    keeper = folder / KEEPER
    with exclusive(folder):
        keeper.mkdir(exist_ok=True)
        keeper.chmod(0o700)
        hidden = _secret_of(keeper / SECRET, secret)
        captures = ensure_captures(
            sealed_items(recipe, hidden),
            keeper / CAPTURES,
            workers,
            engine=engine,
            needs=needs,
        )

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


def _page(recipe: Recipe, secret: str, joint: str) -> SuitePage:
    return SuitePage(recipe, secret_commitment(secret, recipe.to_json()), joint, __version__)


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
    chosen = given or draw_secret()
    write_secret(path, chosen)
    return chosen
