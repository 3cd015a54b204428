"""The files of a sealed suite: where they lie, and the page that binds its organiser."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.records import Digest, Line, parse_record, without_schema
from hwp_bench.sealed.recipe import Recipe

#: Version of the public page.
SUITE_SCHEMA = "hwp-sealed-suite/1"
#: Names inside the folder of a sealed suite. The keeper's part holds the secret and the captures,
#: the publication the part for authors and the sealed part that scores them.
KEEPER, SECRET, CAPTURES, PUBLICATION = "keeper", "secret.json", "captures", "publication"
#: The page, inside the part for authors.
SUITE = "suite.json"
#: Largest page or reveal, bytes.
MAX_FILE = 1_000_000


@dataclass(frozen=True)
class SuitePage:
    """The page that is published before anybody submits: the recipe, and two commitments."""

    #: Everything but the secret.
    recipe: Recipe
    #: Binds the secret and the recipe (`secret.secret_commitment`).
    secret_commitment: Digest
    #: Binds test frames and masks of all captures, the public manifest's `commitment`.
    frames_commitment: Digest
    #: Version of the toolkit that made it.
    toolkit: Line


def write_suite_page(folder: Path, page: SuitePage) -> None:
    """Write the page into the part for authors."""
    write_json(
        folder / SUITE,
        {
            "schema": SUITE_SCHEMA,
            "recipe": page.recipe.to_json(),
            "secret_commitment": page.secret_commitment,
            "frames_commitment": page.frames_commitment,
            "toolkit": page.toolkit,
        },
    )


def read_suite_page(public: str | os.PathLike[str]) -> SuitePage:
    """Read the page of a part for authors.

    Raises:
        BadInput: the folder is not the public part of a sealed suite, or the page is damaged.
    """
    path = Path(public) / SUITE
    if not path.is_file():
        raise BadInput(
            f"holds no {SUITE}",
            where=public,
            remedy="Give the folder public of a suite that `hwp-bench sealed make` made.",
        )
    value = read_json(path, max_bytes=MAX_FILE)
    value = without_schema(value, SUITE_SCHEMA, where=path, error=BadInput)
    return parse_record(SuitePage, value, where=path, error=BadInput)
